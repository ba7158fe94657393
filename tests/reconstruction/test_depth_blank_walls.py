"""A painted wall of which only the outline can be measured is found by the lines in which it meets floor and wall."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from test_depth import CAMERA, CONFIG, look_at, make_posed, quad

from reconstruction.core.rasterize import rasterize_mesh
from reconstruction.depth.blank_walls import fill_walls
from reconstruction.depth.views import plan_views

FLOOR = np.array([0.0, 0.0, 1.0, 0.0])
NORTH = np.array([0.0, -1.0, 0.0, 1.0])
EAST = np.array([-1.0, 0.0, 0.0, 0.9])


def views() -> np.ndarray:
    """Return nine cameras that come towards the east wall and pass along it."""
    return np.stack([look_at((-0.9 + 0.12 * i, -1.5 + 0.05 * i, 1.0), (0.6, 0.6, 0.35)) for i in range(9)])


def render(parts: list, blank: int, shade: float, poses: np.ndarray):
    """Return true depth, which pixels are of part `blank`, and smoothed colors: texture elsewhere, shading there."""
    vertices = np.concatenate([v for v, _ in parts])
    faces = np.concatenate([f + 4 * i for i, (_, f) in enumerate(parts)])
    rng = np.random.default_rng(0)
    depth, mask, tones = [], [], []
    for pose in poses:
        raster = rasterize_mesh(vertices, faces, CAMERA, pose)
        part = np.where(raster.face >= 0, raster.face // 2, -1)
        color = np.repeat(rng.integers(30, 130, (CAMERA.height, CAMERA.width, 1)), 3, 2).astype(np.float32)
        points = raster.interpolate(faces, vertices).reshape(*part.shape, 3)
        color[part == blank] = (190 + shade * points[part == blank][:, 1])[:, None]
        depth.append(raster.depth)
        mask.append(part == blank)
        tones.append(cv2.GaussianBlur(np.clip(color, 0, 255).astype(np.uint8), (0, 0), 1.0))
    return np.stack(depth), np.stack(mask), np.stack(tones)


def fill(parts: list, blank: int, shade: float, planes: np.ndarray):
    poses = views()
    truth, mask, tones = render(parts, blank, shade, poses)
    # Beside the blank part a few pixels are not measured either, as windows have it.
    wide = np.stack([cv2.dilate(m.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0 for m in mask])
    depth = np.where(wide, 0, truth).astype(np.float32)
    confidence = np.where(depth > 0, 2, 0).astype(np.uint8)
    posed = replace(make_posed()[0], world_from_camera=poses)
    found, extents = fill_walls(
        posed, CAMERA, depth.copy(), tones, planes, plan_views(posed, CONFIG), depth, confidence
    )
    return found, extents, depth, confidence, truth, mask


def room() -> list:
    return [
        quad((-3, -3, 0), (0.9, -3, 0), (0.9, 1, 0), (-3, 1, 0)),
        quad((-3, 1, 0), (0.9, 1, 0), (0.9, 1, 2.5), (-3, 1, 2.5)),
        quad((0.9, 1, 0), (0.9, -3, 0), (0.9, -3, 2.5), (0.9, 1, 2.5)),
    ]


@pytest.fixture(scope="module")
def filled():
    return fill(room(), 2, 25.0, np.stack([FLOOR, NORTH]))


def test_a_blank_wall_is_found_where_floor_and_wall_end(filled) -> None:
    found, _, depth, confidence, truth, mask = filled
    assert len(found) == 1
    assert found[0, :3] @ EAST[:3] > np.cos(np.radians(1.0))
    assert abs(found[0, 3] - EAST[3]) < 0.02
    fresh = mask & (depth > 0)
    assert fresh.sum() > 0.8 * mask.sum()
    assert (confidence[fresh] == 1).all()
    assert np.percentile(np.abs(depth[fresh] / truth[fresh] - 1), 95) < 0.02


def test_its_extent_holds_what_was_filled_and_ends(filled) -> None:
    extents = filled[1]
    inside = np.array([0.9, 0.5, 0.5, 1.0])
    beyond = np.array([0.9, 8.0, 0.5, 1.0])
    assert (extents[0] @ inside >= 0).all()
    assert (extents[0] @ beyond < 0).any()


def test_what_shows_no_light_falling_on_it_is_no_wall() -> None:
    found, _, depth, _, _, mask = fill(room(), 2, 0.0, np.stack([FLOOR, NORTH]))
    assert len(found) == 0
    assert (depth[mask] == 0).all()


def test_a_thing_that_hides_the_floor_is_no_wall() -> None:
    """A blank slab in the air ends floor and wall in straight lines too, but elsewhere in each view."""
    slab = quad((0.0, -0.4, 0.4), (0.7, -0.4, 0.4), (0.7, 0.5, 0.6), (0.0, 0.5, 0.6))
    parts = [*room()[:2], slab]
    found, _, depth, _, _, mask = fill(parts, 2, 40.0, np.stack([FLOOR, NORTH]))
    assert len(found) == 0
    assert (depth[mask] == 0).all()
