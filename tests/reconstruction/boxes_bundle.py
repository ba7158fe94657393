"""A sealed bundle of a box on a base surface, small enough to make by the dozen."""

from pathlib import Path

import numpy as np

from registry import seal_bundle
from registry.glb import write_glb_chunks

_OBJ = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"

_POINTS, _CORNERS = np.eye(3, dtype="<f4").tobytes(), np.arange(3, dtype="<u4").tobytes()
_TRIANGLE = {
    "asset": {"version": "2.0"},
    "scene": 0,
    "scenes": [{"nodes": [0]}],
    "nodes": [{"mesh": 0}],
    "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
    "accessors": [
        {
            "bufferView": 0,
            "componentType": 5126,
            "count": 3,
            "type": "VEC3",
            "min": [0, 0, 0],
            "max": [1, 1, 1],
        },
        {"bufferView": 1, "componentType": 5125, "count": 3, "type": "SCALAR"},
    ],
    "bufferViews": [
        {"buffer": 0, "byteOffset": 0, "byteLength": 36},
        {"buffer": 0, "byteOffset": 36, "byteLength": 12},
    ],
    "buffers": [{"byteLength": 48}],
}


def write_bundle(folder: Path, scene_id: str, label: str = "floor") -> Path:
    """Write and seal a bundle; `label` is that of its base surface."""
    folder.mkdir(parents=True)
    for name in ("base.glb", "box.glb"):
        write_glb_chunks(folder / name, _TRIANGLE, _POINTS + _CORNERS)
    (folder / "box.obj").write_text(_OBJ)
    pose = np.eye(4).tolist()
    sources = {"geometry": "made", "appearance": "made", "physics": "made", "observed_fraction": 0.5}
    thing = {
        "id": 2, "label": "box", "label_confidence": 0.5, "world_from_object": pose, "scale": [1.0, 1.0, 1.0],
        "visual": "box.glb", "collision": ["box.obj"], "material": "wood", "density_kg_m3": 600.0, "mass_kg": 1.0,
        "center_of_mass": [0.2, 0.2, 0.2], "friction": 0.5, "restitution": 0.1, "dynamic": True, "views": [0],
        "provenance": sources,
    }  # fmt: skip
    scene = {
        "schema": "simrecon.scene/1",
        "id": scene_id,
        "source": {"file": "made.mp4", "sha256": "0" * 64, "width": 640, "height": 480, "fps": 30.0,
                   "frame_count": 1, "duration_s": 0.1},
        "scale": {"method": "marker", "uncertainty": 0.01},
        "cameras": {"model": "PINHOLE", "width": 640, "height": 480, "params": [500.0, 500.0, 320.0, 240.0],
                    "frames": [{"index": 0, "time_s": 0.0, "world_from_camera": pose}]},
        "base": [{"id": 1, "label": label, "mesh": "base.glb", "plane": [0, 0, 1, 0], "observed": True}],
        "objects": [thing],
        "graph": {"edges": [{"child": 2, "relation": "supported_by", "parent": 1, "confidence": 1.0,
                             "evidence": "made"}]},
        "report": {"physics": {}, "timings_s": {}, "peak_memory_mb": 1.0, "backends": {}, "config": {}},
    }  # fmt: skip
    seal_bundle(folder, scene)
    return folder
