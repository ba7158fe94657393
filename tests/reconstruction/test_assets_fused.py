"""The fused surface of an object: rejection of depth pixels, reliefs on walls."""

from dataclasses import replace

import numpy as np
import pytest
from surfaces import frames_of, merged, sheet, solid_box, surface_from

from reconstruction.assets import AssetsConfig
from reconstruction.assets.build import gather_evidence, object_shape
from reconstruction.assets.fused import fused_points, sample_surface, without_strays
from reconstruction.assets.hanging_relief import mound, relief
from reconstruction.assets.views import prepare_pixels
from reconstruction.assets.volume import ObjectFrame
from reconstruction.core.progress import NO_PROGRESS
from reconstruction.core.types import Instance, InstanceSet

RED = (200, 40, 40)
BOX = Instance(2, "box", 0.5, np.array([0, 0, 0.1]), 0.0, np.array([0.3, 0.3, 0.2]), 1, False)


@pytest.fixture(scope="module")
def room():
    """A box on a floor, drawn into frames; all vertices above the floor are the box's."""
    surface = surface_from(
        merged(
            sheet((-1, -1, 0), (2, 0, 0), (0, 2, 0), (90, 90, 90)),
            solid_box((-0.15, -0.15, 0.0), (0.15, 0.15, 0.2), RED),
        )
    )
    posed, depth = frames_of(surface, 160, 120)
    owner = np.where(surface.vertices[:, 2] > 0.001, 2, 1).astype(np.int32)
    images = np.asarray(posed.images).astype(int)
    ids = np.where(images[..., 0] > images[..., 1] + 60, 2, 1).astype(np.uint16)
    return surface, posed, depth, InstanceSet(owner, (), (BOX,), ids)


def test_depth_off_the_fused_surface_is_dropped(room):
    surface, posed, depth, found = room
    pixels = prepare_pixels(posed, depth, found.id_maps)
    shown = (pixels.ids == 2) & (pixels.depth > 0)
    assert shown.sum() > 500
    assert (without_strays(pixels, posed, depth.camera, surface, found).depth[shown] > 0).mean() > 0.97
    flying = np.argwhere(shown)[::7]
    smeared = pixels.depth.copy()
    smeared[tuple(flying.T)] += 0.5  # behind the box, as flying pixels
    kept = without_strays(replace(pixels, depth=smeared), posed, depth.camera, surface, found).depth
    assert (kept[tuple(flying.T)] == 0).mean() > 0.97
    others = pixels.ids != 2
    np.testing.assert_array_equal(kept[others], smeared[others])


def test_a_displaced_surface_drops_nothing(room):
    surface, posed, depth, found = room
    pixels = prepare_pixels(posed, depth, found.id_maps)
    moved = replace(surface, vertices=surface.vertices + np.float32(0.5))
    np.testing.assert_array_equal(
        without_strays(pixels, posed, depth.camera, moved, found).depth, pixels.depth
    )


def test_samples_are_even_whatever_the_triangles(room):
    surface, _, _, found = room
    samples = sample_surface(2, surface, found)
    on_top = np.abs(samples[:, 2] - 0.2) < 1e-4
    # The top is 900 cm2 of 3,300 in all; the lowest centimetre is shared with the floor.
    assert on_top.mean() == pytest.approx(900 / 3300, abs=0.04)
    frame = ObjectFrame(np.eye(4), samples, samples, False, None)
    assert np.ptp(fused_points(2, frame, surface, found), axis=0) == pytest.approx([0.3, 0.3, 0.2], abs=0.015)
    assert len(sample_surface(7, surface, found)) == 0


def test_a_relief_reaches_from_the_wall_to_the_seen_points():
    """A shelf: a board 60 cm wide and 20 cm deep seen from above, and a front edge 4 cm high."""
    rng = np.random.default_rng(0)
    top = np.column_stack([rng.uniform(-0.3, 0.3, 4000), rng.uniform(-0.2, 0, 4000), np.full(4000, 0.04)])
    edge = np.column_stack([rng.uniform(-0.3, 0.3, 2000), np.full(2000, -0.2), rng.uniform(0, 0.04, 2000)])
    body = relief(np.concatenate([top, edge]), 0.0, AssetsConfig())
    assert body.vertices.min(axis=0) == pytest.approx([-0.3, -0.2, 0.0], abs=0.005)
    assert body.vertices.max(axis=0) == pytest.approx([0.3, 0.0, 0.04], abs=0.005)
    assert body.volume == pytest.approx(0.6 * 0.2 * 0.04, rel=0.15)
    edges = np.sort(np.concatenate([body.faces[:, [a, b]] for a, b in ((0, 1), (1, 2), (2, 0))]), axis=1)
    _, uses = np.unique(edges, axis=0, return_counts=True)
    assert (uses == 2).all()


def test_parts_of_a_relief_have_their_own_depths():
    """A board 3 cm thick with a peg 9 cm long."""
    rng = np.random.default_rng(0)
    board = np.column_stack([rng.uniform(-0.2, 0.2, 6000), np.full(6000, -0.03), rng.uniform(0, 0.1, 6000)])
    on_peg = np.hypot(board[:, 0], board[:, 2] - 0.05) < 0.015
    body = relief(np.where(on_peg[:, None], board - [0, 0.06, 0], board), 0.0, AssetsConfig())
    assert body.vertices[:, 1].min() == pytest.approx(-0.09, abs=1e-3)
    assert body.volume == pytest.approx(0.4 * 0.1 * 0.03 + np.pi * 0.015**2 * 0.06, rel=0.15)
    assert relief(np.zeros((0, 3)), 0.0, AssetsConfig()) is None


def test_a_mound_reaches_from_the_support_to_the_seen_points():
    """A plate whose rim rises from 1 to 2 cm."""
    rng = np.random.default_rng(0)
    radius, turn = 0.12 * np.sqrt(rng.uniform(0, 1, 8000)), rng.uniform(0, 2 * np.pi, 8000)
    height = 0.01 + 0.01 * (radius > 0.1)
    body = mound(np.column_stack([radius * np.cos(turn), radius * np.sin(turn), height]), AssetsConfig())
    assert body.vertices.min(axis=0) == pytest.approx([-0.12, -0.12, 0.0], abs=0.006)
    assert body.vertices.max(axis=0) == pytest.approx([0.12, 0.12, 0.02], abs=0.006)
    assert body.volume == pytest.approx(np.pi * (0.12**2 * 0.01 + (0.12**2 - 0.1**2) * 0.01), rel=0.25)
    assert mound(np.zeros((0, 3)), AssetsConfig()) is None


def shown_beyond(room, low_m):
    """Return the instances with id maps that show the box only where x and y are at least `low_m`."""
    _, posed, depth, found = room
    camera = depth.camera
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    left = found.id_maps.copy()
    for ids, z, pose in zip(left, depth.depth, posed.world_from_camera):
        local = np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], axis=-1)
        ids[((local @ pose[:3, :3].T + pose[:3, 3])[..., :2] < low_m).any(axis=-1)] = 1
    assert 100 < (left == 2).sum() < 0.3 * (found.id_maps == 2).sum()
    return replace(found, id_maps=left)


@pytest.mark.parametrize(
    ("furniture_m", "how"), [(0.5, "observed+relief"), (0.15, "box-fallback")], ids=["small", "furniture"]
)
def test_an_object_with_few_pixels_is_as_large_as_its_fused_surface(room, furniture_m, how):
    """Borders that snap to color edges remove most of an object of few pixels."""
    surface, posed, depth, _ = room
    config = AssetsConfig(furniture_m=furniture_m)
    scene = gather_evidence(posed, depth, surface, shown_beyond(room, 0.05), config, NO_PROGRESS)
    shape = object_shape(BOX, scene)
    assert shape.how == how
    assert shape.body.extents == pytest.approx([0.3, 0.3, 0.2], abs=0.03)
