"""Fixtures for a small handmade bundle: a floor, a table and a cup on it."""

import copy
import json
import struct
from pathlib import Path

import numpy as np
import pytest

from registry import seal_bundle


def _glb_bytes(document: dict | None = None) -> bytes:
    """Return a binary glTF file with only a JSON chunk."""
    text = json.dumps(document or {"asset": {"version": "2.0"}}).encode()
    text += b" " * (-len(text) % 4)
    return struct.pack("<5I", 0x46546C67, 2, 20 + len(text), len(text), 0x4E4F534A) + text


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


@pytest.fixture
def scene() -> dict:
    """Return a new, valid scene.json."""
    return copy.deepcopy(SCENE)


@pytest.fixture
def glb_bytes():
    """Return a function that creates a binary glTF file from a JSON document."""
    return _glb_bytes


@pytest.fixture
def write_files():
    """Return a function that writes the mesh files named in `scene`."""
    return _write_files


@pytest.fixture
def make_staging(tmp_path):
    """Return a function that seals a bundle in a fresh folder: `make_staging(scene, marker)`."""
    count = iter(range(1_000_000))

    def make(scene: dict | None = None, marker: str = "") -> Path:
        folder = tmp_path / f"staging{next(count)}"
        _write_files(folder, marker)
        seal_bundle(folder, copy.deepcopy(SCENE) if scene is None else scene)
        return folder

    return make


def _write_files(folder: Path, marker: str = "") -> None:
    for name in ("base/floor.glb", "objects/002/visual.glb", "objects/003/visual.glb"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(_glb_bytes())
    for name in ("base/floor_000.obj", "objects/002/collision_000.obj", "objects/003/collision_000.obj"):
        (folder / name).write_text(f"# {marker}\n{OBJ_TEXT}")


@pytest.fixture(scope="session")
def make_bundle(tmp_path_factory):
    """Return a function that seals a tiny bundle in a new folder: `make_bundle(scene id, marker)`."""

    def make(scene_id: str = "room", marker: str = "") -> Path:
        folder = tmp_path_factory.mktemp("bundle")
        _write_files(folder, marker)
        seal_bundle(folder, copy.deepcopy(SCENE) | {"id": scene_id})
        return folder

    return make
