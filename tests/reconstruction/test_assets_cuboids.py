"""Boxes of which some sides were seen; free space inside, and round objects, are rejected."""

import numpy as np

from reconstruction.assets.cuboids import unfreed_cuboid
from reconstruction.assets.volume import ObjectFrame, ObjectVolume

_HALF, _HEIGHT, _VOXEL = np.array([0.1, 0.06]), 0.12, 0.005


def _volume(free_inside=False):
    """A volume that is unknown inside the box and free outside."""
    shape = (60, 44, 34)
    low = np.array([-0.15, -0.11, -0.02])
    centers = low + (np.stack(np.indices(shape), -1) + 0.5) * _VOXEL
    inside = (
        (np.abs(centers[..., :2]) < _HALF).all(axis=-1) & (centers[..., 2] > 0) & (centers[..., 2] < _HEIGHT)
    )
    known = ~inside
    if free_inside:
        known |= centers[..., 2] > 0.6 * _HEIGHT
    distance = np.full(shape, 0.01, np.float32)
    return ObjectVolume(low, _VOXEL, 0.015, 0.001, distance, known, known, np.zeros(shape, bool))


def _frame(sides, count=3000):
    """Points on some sides of the box, each (axis, way)."""
    rng = np.random.default_rng(0)
    low, high = np.array([*-_HALF, 0.0]), np.array([*_HALF, _HEIGHT])
    points, normals = [], []
    for axis, way in sides:
        on = rng.uniform(low, high, (count, 3))
        on[:, axis] = (low if way < 0 else high)[axis]
        points.append(on + rng.normal(0, 0.001, on.shape))
        normals.append(np.tile(way * np.eye(3)[axis], (count, 1)))
    return ObjectFrame(
        np.eye(4), np.concatenate(points), np.concatenate(normals), on_support=True, wall_y=None
    )


def test_two_upright_sides_make_a_box():
    body = unfreed_cuboid(_volume(), _frame([(0, 1), (1, -1)]), 0.003)
    np.testing.assert_allclose(body.vertices.max(axis=0), [*_HALF, _HEIGHT], atol=0.004)
    np.testing.assert_allclose(body.vertices.min(axis=0), [*-_HALF, 0.0], atol=0.004)


def test_one_side_does_not_determine_the_depth():
    assert unfreed_cuboid(_volume(), _frame([(1, -1)]), 0.003) is None
    assert unfreed_cuboid(_volume(), _frame([(1, -1), (1, 1)]), 0.003) is None


def test_free_space_inside_is_no_box():
    sides = [(0, 1), (0, -1), (1, -1), (1, 1)]
    assert unfreed_cuboid(_volume(), _frame(sides), 0.003) is not None
    assert unfreed_cuboid(_volume(free_inside=True), _frame(sides), 0.003) is None


def test_a_cylinder_is_no_box():
    rng = np.random.default_rng(0)
    angle, height = rng.uniform(0, 2 * np.pi, 6000), rng.uniform(0, _HEIGHT, 6000)
    around = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(6000)])
    top = 0.06 * np.sqrt(rng.uniform(0, 1, 1500))[:, None] * around[:1500] + [0.0, 0.0, _HEIGHT]
    points = np.concatenate([0.06 * around + height[:, None] * [0.0, 0.0, 1.0], top])
    normals = np.concatenate([around, np.tile([0.0, 0.0, 1.0], (1500, 1))])
    # Even with a tolerance as large as the gaps between it and its box.
    assert unfreed_cuboid(_volume(), ObjectFrame(np.eye(4), points, normals, True, None), 0.02) is None
