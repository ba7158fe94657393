"""Generated meshes that fill a seen hollow are rejected; true ones are accepted, slightly displaced ones, too."""

import numpy as np
import pytest
import trimesh
from generation_servers import as_glb, thing_mesh
from test_generation_registration import free_around

from reconstruction.assets.config import AssetsConfig
from reconstruction.assets.generation.filling import filled_share
from reconstruction.assets.generation.meshes import read_generated
from reconstruction.assets.generation.solidify import closed_solid
from reconstruction.assets.solid import manifold_of
from synthetic.containers import make_basket, make_bowl, make_crate, make_mug
from synthetic.furnishing import (
    make_bench,
    make_bookcase,
    make_cabinet,
    make_chair,
    make_round_table,
    make_stool,
    make_table,
)

pytestmark = pytest.mark.stage

BOUND = AssetsConfig().generator_filling
HOLLOW = [
    (make_table, 0.0), (make_round_table, 0.0), (make_bench, 0.0), (make_stool, 0.0), (make_chair, 0.0),
    (make_bookcase, 0.0), (make_bowl, 0.5), (make_mug, 0.5), (make_crate, 0.5), (make_basket, 0.5),
]  # fmt: skip


def cameras(stands_at: float) -> list[np.ndarray]:
    """Four places on the open side of a thing, as high as one holds a camera above the floor."""
    angles = np.radians((-109.0, -92.0, -75.0, -58.0))
    return [np.array([1.7 * np.cos(a), 1.7 * np.sin(a), 1.5 - stands_at]) for a in angles]


def near_of(mesh: trimesh.Trimesh) -> float:
    return max(0.01, 0.03 * float(mesh.extents.max()))


def filling(mesh: trimesh.Trimesh, free, near_m: float) -> float:
    """Return the free share of the volume of a closed mesh."""
    body = manifold_of(closed_solid(read_generated(as_glb(mesh)), AssetsConfig(), 6000))
    return filled_share(body, free, near_m)


@pytest.mark.parametrize(("make", "stands_at"), HOLLOW)
def test_filled_meshes_are_detected_and_displaced_ones_are_not(make, stands_at):
    mesh = thing_mesh(make, seed=1)
    free, near = free_around(mesh, cameras(stands_at)), near_of(mesh)
    assert filling(mesh, free, near) == 0.0
    for way in ((0.01, 0, 0), (0, -0.01, 0), (0.007, 0.007, 0)):
        off = mesh.copy()
        off.apply_translation(way)
        assert filling(off, free, near) < 0.01
    assert filling(mesh.convex_hull, free, near) > BOUND


def test_massive_objects_are_accepted():
    mesh = thing_mesh(make_cabinet, seed=1)
    free, near = free_around(mesh, cameras(0.0)), near_of(mesh)
    assert filling(mesh, free, near) == 0.0
    assert filling(mesh.convex_hull, free, near) == 0.0


def test_an_unseen_hollow_may_be_filled():
    mesh = thing_mesh(make_bookcase, seed=1)
    behind = [eye * [1, -1, 1] for eye in cameras(0.0)]
    assert filling(mesh.convex_hull, free_around(mesh, behind), near_of(mesh)) == 0.0


def test_the_share_is_that_of_the_volume():
    """A cube of 40 cm, of whose lower half what is deeper inside than 5 cm is free."""
    import manifold3d

    body = manifold3d.Manifold.cube((0.4, 0.4, 0.4)).translate((1.0, -2.0, 0.0))
    share = filled_share(body, lambda points: (points[:, 2] < 0.2).astype(float), 0.05)
    assert share == pytest.approx(0.3 * 0.3 * 0.15 / 0.4**3, rel=0.05)


def test_narrow_free_lanes_between_legs_count():
    import manifold3d

    body = manifold3d.Manifold.cube((1.0, 1.0, 1.0))
    share = filled_share(body, lambda points: 0.02 * (np.floor(points[:, 0] / 0.04) % 2), 0.03)
    assert share == pytest.approx(0.5 * 0.94**3, rel=0.1)
