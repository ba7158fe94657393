"""Mesh files: axes, texture orientation, round trips, determinism."""

import numpy as np
import pytest

from reconstruction.assets.gltf import read_glb, read_obj, write_glb, write_obj
from reconstruction.core.types import ConvexPart, TexturedMesh
from registry.errors import BundleError
from registry.meshfiles import check_mesh_file


@pytest.fixture
def mesh() -> TexturedMesh:
    rng = np.random.default_rng(0)
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]], np.float32)
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.int32)
    uvs = rng.random((4, 2)).astype(np.float32)
    return TexturedMesh(vertices, faces, uvs, rng.integers(0, 255, (16, 16, 3), dtype=np.uint8))


def test_glb_round_trip(mesh, tmp_path):
    write_glb(mesh, tmp_path / "a.glb")
    check_mesh_file(tmp_path / "a.glb", "a.glb")
    back = read_glb(tmp_path / "a.glb")
    np.testing.assert_allclose(back.vertices, mesh.vertices, atol=1e-6)
    np.testing.assert_array_equal(back.faces, mesh.faces)
    np.testing.assert_allclose(back.uvs, mesh.uvs, atol=1e-6)
    np.testing.assert_array_equal(back.texture, mesh.texture)


def test_glb_is_y_up_and_oriented_for_other_readers(mesh, tmp_path):
    trimesh = pytest.importorskip("trimesh")
    write_glb(mesh, tmp_path / "a.glb")
    other = trimesh.load(tmp_path / "a.glb", force="mesh", process=False)
    np.testing.assert_allclose(other.extents, [1, 3, 2], atol=1e-6)
    assert other.volume == pytest.approx(1.0, abs=1e-6)
    # trimesh flips v to a lower-left origin, which is ours.
    np.testing.assert_allclose(other.visual.uv, mesh.uvs, atol=1e-6)


def test_glb_bytes_are_deterministic(mesh, tmp_path):
    write_glb(mesh, tmp_path / "a.glb")
    write_glb(mesh, tmp_path / "b.glb")
    assert (tmp_path / "a.glb").read_bytes() == (tmp_path / "b.glb").read_bytes()


def test_the_error_of_a_damaged_glb_names_the_file(tmp_path):
    (tmp_path / "bad.glb").write_bytes(b"glTF nonsense")
    with pytest.raises(BundleError, match=r"bad\.glb"):
        read_glb(tmp_path / "bad.glb")


def test_obj_round_trip(mesh, tmp_path):
    part = ConvexPart(mesh.vertices, mesh.faces)
    write_obj(part, tmp_path / "a.obj")
    check_mesh_file(tmp_path / "a.obj", "a.obj")
    back = read_obj(tmp_path / "a.obj")
    np.testing.assert_allclose(back.vertices, part.vertices, atol=1e-6)
    np.testing.assert_array_equal(back.faces, part.faces)
