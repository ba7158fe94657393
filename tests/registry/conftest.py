"""Fixtures for a small handmade bundle: a floor, a table and a cup on it."""

import copy
from pathlib import Path

import pytest

from registry import seal_bundle
from synthetic.small_bundle import SCENE, pack_glb, triangle_document, write_small_bundle, write_small_files


def _glb_bytes(document: dict | None = None) -> bytes:
    return pack_glb(document or triangle_document())


@pytest.fixture
def scene() -> dict:
    """Return a new, valid scene.json."""
    return copy.deepcopy(SCENE)


@pytest.fixture
def glb_bytes():
    """Return a function that creates a binary glTF file, by default of one triangle."""
    return _glb_bytes


@pytest.fixture
def write_files():
    """Return a function that writes the mesh files named in `scene`."""
    return write_small_files


@pytest.fixture
def make_staging(tmp_path):
    """Return a function that seals a bundle in a fresh folder: `make_staging(scene, marker)`."""
    count = iter(range(1_000_000))

    def make(scene: dict | None = None, marker: str = "") -> Path:
        folder = tmp_path / f"staging{next(count)}"
        write_small_files(folder, marker)
        seal_bundle(folder, copy.deepcopy(SCENE) if scene is None else scene)
        return folder

    return make


@pytest.fixture(scope="session")
def make_bundle(tmp_path_factory):
    """Return a function that seals a tiny bundle in a new folder: `make_bundle(scene id, marker)`."""

    def make(scene_id: str = "room", marker: str = "") -> Path:
        folder = tmp_path_factory.mktemp("bundle")
        write_small_bundle(folder, scene_id, marker)
        return folder

    return make
