"""Depth beside outlines and on blank faces: a plain table top over a patterned floor, and boxes on it."""

from dataclasses import replace

import numpy as np
import pytest

from reconstruction.core.rasterize import rasterize_mesh
from reconstruction.core.types import Camera, PosedFrames, VideoSource
from reconstruction.depth import DepthConfig, estimate_depth

pytestmark = pytest.mark.stage

CAMERA = Camera(240, 180, 210.0, 210.0, 120.0, 90.0)
CONFIG = DepthConfig(depth_side_px=240, sweep_side_px=160, planes=64, min_speckle_px=20, prior="none")
FLOOR, WALL, TABLE, BOX = 0, 1, 2, 3
TABLE_LOW, TABLE_HIGH = np.array([-0.45, -0.25, 0.25]), np.array([0.45, 0.35, 0.3])
BOXES = (
    (np.array([-0.3, 0.0, 0.3]), np.array([-0.18, 0.1, 0.5])),
    (np.array([0.12, -0.05, 0.3]), np.array([0.26, 0.08, 0.42])),
)


def solid(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    corners = np.array([[(low, high)[i >> a & 1][a] for a in range(3)] for i in range(8)])
    sides = [(0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (0, 2, 6, 4), (1, 3, 7, 5)]
    return corners, np.array([t for a, b, c, d in sides for t in ((a, b, c), (a, c, d))])


def room() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return vertices, faces and the kind of each face."""
    quad = np.array([[0, 1, 2], [0, 2, 3]])
    parts = [
        (np.array([(-3, -3, 0), (3, -3, 0), (3, 1.2, 0), (-3, 1.2, 0)], float), quad, FLOOR),
        (np.array([(-3, 1.2, 0), (3, 1.2, 0), (3, 1.2, 3), (-3, 1.2, 3)], float), quad, WALL),
        (*solid(TABLE_LOW, TABLE_HIGH), TABLE),
        *((*solid(*box), BOX) for box in BOXES),
    ]
    vertices, faces, kinds, count = [], [], [], 0
    for v, f, kind in parts:
        vertices.append(v)
        faces.append(f + count)
        kinds.append(np.full(len(f), kind))
        count += len(v)
    return np.concatenate(vertices), np.concatenate(faces), np.concatenate(kinds)


def pattern(points: np.ndarray, kind: np.ndarray) -> np.ndarray:
    """Return colors (n, 3): floor, wall and boxes are patterned in space, the table is plain."""
    rng = np.random.default_rng(7)
    wave = np.zeros(len(points))
    for _ in range(40):
        direction = rng.normal(size=3)
        direction *= rng.uniform(15, 80) / np.linalg.norm(direction)
        wave += 7 * np.sin(points @ direction + rng.uniform(0, 6.28))
    base = np.array([[175, 150, 115], [150, 165, 170], [62, 58, 60], [190, 60, 50]], float)
    return base[kind] + np.where(kind == TABLE, 0.0, wave)[:, None]


def look_at(eye, target) -> np.ndarray:
    forward = np.subtract(target, eye) / np.linalg.norm(np.subtract(target, eye))
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    out = np.eye(4)
    out[:3, :3] = np.stack([right, np.cross(forward, right), forward], 1)
    out[:3, 3] = eye
    return out


@pytest.fixture(scope="module")
def filmed():
    """Return posed frames, true depth (n, h, w) and true kinds (n, h, w)."""
    rng = np.random.default_rng(0)
    vertices, faces, kinds = room()
    images, depth, kind_maps, poses, points, seen = [], [], [], [], [], []
    for i, angle in enumerate(np.linspace(-0.45, 0.45, 14)):
        pose = look_at(
            (1.7 * np.sin(angle), -1.5 * np.cos(angle), 1.0 + 0.08 * np.sin(4 * angle)), (0, 0.1, 0.3)
        )
        # Twice the resolution, averaged: pixels on outlines are mixed, as a camera's are.
        large = CAMERA.resized(2 * CAMERA.width, 2 * CAMERA.height)
        raster = rasterize_mesh(vertices, faces, large, pose)
        shape = raster.depth.shape
        color = pattern(
            raster.interpolate(faces, vertices).reshape(-1, 3).astype(np.float64),
            kinds[np.maximum(raster.face, 0)].reshape(-1),
        ).reshape(*shape, 3)
        color = color.reshape(CAMERA.height, 2, CAMERA.width, 2, 3).mean((1, 3))
        color += rng.normal(0, 1.0, color.shape)
        small = rasterize_mesh(vertices, faces, CAMERA, pose)
        z = small.depth
        y, x = rng.integers(0, CAMERA.height, 120), rng.integers(0, CAMERA.width, 120)
        y, x = y[z[y, x] > 0], x[z[y, x] > 0]
        rays = np.stack(
            [(x + 0.5 - CAMERA.cx) / CAMERA.fx, (y + 0.5 - CAMERA.cy) / CAMERA.fy, np.ones(len(x))], 1
        )
        first = sum(len(p) for p in points)
        points.append(rays * z[y, x][:, None] @ pose[:3, :3].T + pose[:3, 3])
        seen.append(np.stack([np.full(len(x), i), np.arange(first, first + len(x))], 1))
        images.append(np.clip(color, 0, 255).astype(np.uint8))
        depth.append(z)
        kind_maps.append(np.where(small.face >= 0, kinds[np.maximum(small.face, 0)], -1))
        poses.append(pose)
    n, cloud = len(images), np.concatenate(points)
    frames = np.stack(images)
    posed = PosedFrames(
        VideoSource("room.mp4", "0" * 64, CAMERA.width, CAMERA.height, 30.0, n, n / 30),
        CAMERA, frames, np.arange(n, dtype=np.int32), np.arange(n) / 30, np.stack(poses), np.ones(n, np.float32),
        frames[:0], np.zeros(0, np.int32), np.zeros(0), np.zeros((0, 4, 4)), cloud,
        np.zeros((len(cloud), 3), np.uint8), np.ones(len(cloud), np.float32),
        np.concatenate(seen).astype(np.int32), n, True, 0.3,
    )  # fmt: skip
    return posed, np.stack(depth), np.stack(kind_maps)


@pytest.fixture(scope="module")
def estimate(filmed):
    return estimate_depth(filmed[0], CONFIG)


def beside_outlines(depth: np.ndarray, reach: int) -> np.ndarray:
    """Return the pixels (h, w) within `reach` of a jump of true depth."""
    from scipy.ndimage import maximum_filter

    inverse = np.where(depth > 0, 1 / np.maximum(depth, 1e-6), 0)
    bend = np.zeros(depth.shape)
    bend[:, 1:-1] = np.abs(inverse[:, 2:] - 2 * inverse[:, 1:-1] + inverse[:, :-2])
    bend[1:-1] = np.maximum(bend[1:-1], np.abs(inverse[2:] - 2 * inverse[1:-1] + inverse[:-2]))
    return maximum_filter(bend > 0.03 * inverse, 2 * reach + 1)


def test_things_wear_no_skirts(filmed, estimate) -> None:
    """Of the pixels beside outlines few lie far from the surface that they show, and fewer still before it."""
    _, truth, _ = filmed
    band = np.stack([beside_outlines(z, 6) for z in truth]) & (truth > 0) & (estimate.depth > 0)
    ratio = estimate.depth[band] / truth[band]
    assert (np.abs(ratio - 1) > 0.05).mean() < 0.06
    assert (ratio < 0.95).mean() < 0.03


def test_plain_table_top_is_not_filled_with_the_floor_beneath(filmed, estimate) -> None:
    _, truth, kind = filmed
    table = (kind == TABLE) & (estimate.depth > 0)
    behind = estimate.depth[table] > 1.05 * truth[table]
    assert table.sum() > 0.3 * (kind == TABLE).sum()
    assert behind.mean() < 0.06


def test_outlines_keep_what_is_known(filmed, estimate) -> None:
    """Edges are put right, not cut out."""
    _, truth, kind = filmed
    boxes = kind == BOX
    right = np.abs(estimate.depth / truth.clip(1e-6) - 1) < 0.03
    assert right[boxes].mean() > 0.8
    assert (estimate.depth > 0)[truth > 0].mean() > 0.87


def test_threads_do_not_change_the_result(filmed, estimate) -> None:
    again = estimate_depth(filmed[0], replace(CONFIG, threads=1))
    assert np.array_equal(again.depth, estimate.depth)
    assert np.array_equal(again.confidence, estimate.confidence)
