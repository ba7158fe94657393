"""A small handmade bundle, 12 kB: a floor, a table and a cup on it. For tests and measurements of the registry."""

import copy
import json
import struct
from pathlib import Path

import numpy as np

from registry import seal_bundle


def triangle_document() -> dict:
    """Return the JSON of a glTF file with one triangle; `TRIANGLE` is its binary chunk."""
    return {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5125, "count": 3, "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": 36},
            {"buffer": 0, "byteOffset": 36, "byteLength": 12},
        ],
        "buffers": [{"byteLength": 48}],
    }


TRIANGLE = np.array([0, 0, 0, 1, 0, 0, 0, 1, 0], "<f4").tobytes() + np.array([0, 1, 2], "<u4").tobytes()


def pack_glb(document: dict | str, binary: bytes = TRIANGLE) -> bytes:
    """Return a binary glTF file of a JSON document (or its text) and a binary chunk."""
    text = (document if isinstance(document, str) else json.dumps(document)).encode()
    text += b" " * (-len(text) % 4)
    binary += b"\0" * (-len(binary) % 4)
    head = struct.pack("<5I", 0x46546C67, 2, 28 + len(text) + len(binary), len(text), 0x4E4F534A)
    return head + text + struct.pack("<2I", len(binary), 0x004E4942) + binary


OBJ_TEXT = "o part\nv 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"


def object_entry(number: int, label: str, height_m: float) -> dict:
    """Return one entry of `objects`."""
    world_from_object = np.eye(4)
    world_from_object[2, 3] = height_m
    return {
        "id": number,
        "label": label,
        "label_confidence": 0.8,
        "world_from_object": world_from_object.tolist(),
        "scale": [0.5, 0.4, 0.3],
        "visual": f"objects/{number:03d}/visual.glb",
        "collision": [f"objects/{number:03d}/collision_000.obj"],
        "material": "wood",
        "density_kg_m3": 600.0,
        "mass_kg": 3.5,
        "center_of_mass": [0.0, 0.0, 0.15],
        "inertia": [[0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]],
        "friction": 0.6,
        "restitution": 0.1,
        "ranges": {"mass_kg": [2.0, 5.0], "friction": [0.4, 0.7], "restitution": [0.1, 0.1]},
        "dynamic": True,
        "relation_fixed": False,
        "provenance": {
            "geometry": "observed+completed",
            "appearance": "observed",
            "physics": "table",
            "observed_fraction": 0.7,
        },
        "views": [3, 9],
    }


SCENE = {
    "schema": "simrecon.scene/1",
    "id": "scene0001",
    "source": {
        "file": "video.mp4",
        "sha256": "ab" * 32,
        "width": 640,
        "height": 480,
        "fps": 30.0,
        "frame_count": 100,
        "duration_s": 3.33,
    },
    "scale": {"method": "camera-height-prior", "uncertainty": 0.12},
    "cameras": {
        "model": "PINHOLE",
        "width": 640,
        "height": 480,
        "params": [500.0, 500.0, 320.0, 240.0],
        "frames": [
            {"index": i, "time_s": i / 30, "world_from_camera": np.eye(4).tolist()} for i in (0, 3, 9)
        ],
    },
    "base": [
        {
            "id": 1,
            "label": "floor",
            "mesh": "base/floor.glb",
            "plane": [0, 0, 1, 0],
            "observed": True,
            "collision": ["base/floor_000.obj"],
        }
    ],
    "objects": [object_entry(2, "table", 0.0), object_entry(3, "cup", 0.3)],
    "graph": {
        "edges": [
            {"child": 3, "relation": "supported_by", "parent": 2, "confidence": 0.9, "evidence": "contact"},
            {"child": 2, "relation": "supported_by", "parent": 1, "confidence": 0.9, "evidence": "contact"},
        ]
    },
    "report": {
        "physics": {"stable_rate": 1.0, "spawn_penetration_mm": 0.2},
        "timings_s": {"frames": 1.5},
        "peak_memory_mb": 800.0,
        "backends": {},
        "config": {},
    },
}


def write_small_files(folder: Path, marker: str = "") -> None:
    """Write the mesh files named in `SCENE`; another marker gives another revision."""
    for name in ("base/floor.glb", "objects/002/visual.glb", "objects/003/visual.glb"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(pack_glb(triangle_document()))
    for name in ("base/floor_000.obj", "objects/002/collision_000.obj", "objects/003/collision_000.obj"):
        (folder / name).write_text(f"# {marker}\n{OBJ_TEXT}")


def write_small_bundle(folder: Path, scene_id: str = "room", marker: str = "") -> str:
    """Write and seal the bundle in a new folder; return its revision, which depends on the marker only."""
    write_small_files(folder, marker)
    return seal_bundle(folder, copy.deepcopy(SCENE) | {"id": scene_id})
