"""A sealed bundle of a box on a base surface, small enough to make by the dozen."""

import json
import struct
from pathlib import Path

import numpy as np

from registry import seal_bundle

_OBJ = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"


def write_bundle(folder: Path, scene_id: str, label: str = "floor") -> Path:
    """Write and seal a bundle; `label` is that of its base surface."""
    text = json.dumps({"asset": {"version": "2.0"}}).encode()
    text += b" " * (-len(text) % 4)
    folder.mkdir(parents=True)
    for name in ("base.glb", "box.glb"):
        (folder / name).write_bytes(
            struct.pack("<5I", 0x46546C67, 2, 20 + len(text), len(text), 0x4E4F534A) + text
        )
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
