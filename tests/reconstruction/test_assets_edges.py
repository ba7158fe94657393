"""Meshes stay watertight for readers that merge vertices by position."""

import numpy as np
import pytest
import trimesh

from reconstruction.assembly.base import convex_part
from reconstruction.assets.collision.build import hull_part
from reconstruction.assets.edges import with_simple_edges
from reconstruction.assets.gltf import read_obj, write_obj
from reconstruction.assets.solid import Solid, box_solid, manifold_of


def joined(*solids: Solid) -> Solid:
    offsets = np.cumsum([0, *(len(s.vertices) for s in solids[:-1])])
    return Solid(
        np.concatenate([s.vertices for s in solids]),
        np.concatenate([s.faces + o for s, o in zip(solids, offsets)]),
    )


def is_watertight(solid: Solid) -> bool:
    """Merge vertices by position, as readers do."""
    return trimesh.Trimesh(solid.vertices.astype(np.float32), solid.faces, process=True).is_watertight


def test_two_boxes_that_touch_along_an_edge():
    """They share 10 cm of an edge."""
    first = box_solid(np.zeros(3), np.array([0.1, 0.1, 0.2]))
    second = box_solid(np.array([0.1, 0.1, 0.0]), np.array([0.2, 0.2, 0.2]))
    touching = joined(first, second)
    assert not is_watertight(touching)
    mended = with_simple_edges(touching)
    assert is_watertight(mended)
    assert manifold_of(mended) is not None
    assert mended.volume == pytest.approx(2 * 0.1 * 0.1 * 0.2)
    np.testing.assert_allclose(mended.extents, touching.extents)
    again = with_simple_edges(mended)
    np.testing.assert_array_equal(again.faces.shape, mended.faces.shape)


def test_opposite_and_degenerate_faces_are_dropped():
    box = box_solid(np.zeros(3), np.full(3, 0.1))
    fin = np.array([[0, 3, 5], [0, 5, 3], [2, 2, 7], [2, 7, 2]], np.int32)
    mended = with_simple_edges(Solid(box.vertices, np.concatenate([box.faces, fin])))
    assert is_watertight(mended)
    assert len(mended.faces) == len(box.faces)
    assert mended.volume == pytest.approx(1e-3)


def test_watertight_meshes_keep_their_surface_and_open_ones_are_returned():
    box = box_solid(np.zeros(3), np.full(3, 0.1))
    assert with_simple_edges(box).volume == pytest.approx(1e-3)
    opened = Solid(box.vertices, box.faces[:-1])
    assert with_simple_edges(opened) is opened


def test_corners_at_one_position_are_merged_in_the_file(tmp_path):
    """A hull keeps corners that float32 does not tell apart; the file has them once, and no hole between them."""
    box = box_solid(np.zeros(3), np.array([0.3, 0.2, 0.1]))
    corner = box.vertices[-1]
    twice = corner - 1e-9 * np.array([[0, 0, 1], [0, 1, 0]])
    part = convex_part(np.concatenate([box.vertices[:-1], twice]))
    assert len(part.vertices) == 9
    write_obj(part, tmp_path / "part.obj")
    back = read_obj(tmp_path / "part.obj")
    assert len(back.vertices) == 8
    assert is_watertight(Solid(back.vertices.astype(float), back.faces))
    assert Solid(back.vertices.astype(float), back.faces).volume == pytest.approx(0.006)


def test_collision_parts_are_watertight_in_their_files(tmp_path):
    """Corners a hundredth of a micrometre apart are one in the file."""
    rng = np.random.default_rng(1)
    corners = box_solid(np.zeros(3), np.array([0.3, 0.2, 0.1])).vertices
    part = hull_part(np.concatenate([corners, corners + rng.uniform(-1e-8, 1e-8, corners.shape)]))
    write_obj(part, tmp_path / "part.obj")
    back = read_obj(tmp_path / "part.obj")
    assert is_watertight(Solid(back.vertices.astype(float), back.faces))
