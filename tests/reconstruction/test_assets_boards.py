"""Undersides of table tops: the rim gives the thickness, and legs reach the floor."""

import numpy as np
import pytest

from reconstruction.assets.boards import find_board, with_underside
from reconstruction.assets.completion import complete
from reconstruction.assets.config import AssetsConfig
from reconstruction.assets.solid import extract
from reconstruction.assets.volume import ObjectFrame, ObjectVolume

_HALF, _TOP, _THICK, _LEG, _VOXEL, _BAND = np.array([0.4, 0.25]), 0.5, 0.03, 0.06, 0.008, 0.02


def _box_distance(points, low, high):
    """Signed distance of points (n, 3) to a box."""
    out = np.maximum(low - points, points - high)
    return np.linalg.norm(np.maximum(out, 0.0), axis=1) + np.minimum(out.max(axis=1), 0.0)


def _table(apron=False):
    """Return the volume and frame of a table seen from above: the space below its top is unknown."""
    low = np.array([*(-_HALF - 0.06), -2 * _VOXEL])
    shape = tuple(np.ceil((np.array([*(_HALF + 0.06), _TOP + 0.05]) - low) / _VOXEL).astype(int))
    centers = low + (np.stack(np.indices(shape), -1).reshape(-1, 3) + 0.5) * _VOXEL
    board = _box_distance(centers, np.array([*-_HALF, _TOP - _THICK]), np.array([*_HALF, _TOP]))
    parts = [board]
    for sx in (-1, 1):
        for sy in (-1, 1):
            corner = np.array([sx, sy]) * (_HALF - 0.5 * _LEG)
            parts.append(
                _box_distance(
                    centers, np.array([*(corner - 0.5 * _LEG), 0.0]), np.array([*(corner + 0.5 * _LEG), _TOP])
                )
            )
    distance = np.min(parts, axis=0)
    beneath = (np.abs(centers[:, :2]) < _HALF).all(axis=1) & (centers[:, 2] < _TOP - 0.3 * _THICK)
    unknown = (distance < -_BAND) | (beneath & (np.min(parts[1:], axis=0) > 0.03))
    known = ~unknown
    if apron:  # seen from outside, so that the space between counts as enclosed
        inset = np.abs(centers[:, :2]) - (_HALF - 0.05)
        known |= (np.abs(inset.max(axis=1)) < 0.01) & (centers[:, 2] > _TOP - 0.08)
        distance = np.where(known & unknown, -0.005, distance)
    clipped = np.clip(distance, -_BAND, _BAND).astype(np.float32).reshape(shape)
    known = known.reshape(shape)
    free = known & (clipped > 0)
    rng = np.random.default_rng(0)
    top = np.column_stack([rng.uniform(-_HALF, _HALF, (4000, 2)), np.full(4000, _TOP)])
    rim = rng.uniform([*-_HALF, _TOP - _THICK], [*_HALF, _TOP], (4000, 3))
    rim[::2, 0], rim[1::2, 1] = _HALF[0], -_HALF[1]
    points = np.concatenate([top, rim])
    normals = np.zeros_like(points)
    normals[:4000, 2], normals[4000::2, 0], normals[4001::2, 1] = 1.0, 1.0, -1.0
    volume = ObjectVolume(low, _VOXEL, _BAND, 0.002, clipped, known, free, known & (np.abs(clipped) < _BAND))
    return volume, ObjectFrame(np.eye(4), points, normals, on_support=True, wall_y=None)


def test_thickness_is_measured_at_the_rim():
    board = find_board(*_table())
    assert board.top_m == pytest.approx(_TOP, abs=0.003)
    assert board.thickness_m == pytest.approx(_THICK, abs=0.005)
    assert board.plan.sum() * _VOXEL**2 == pytest.approx(np.prod(2 * _HALF), rel=0.1)


def test_a_block_that_continues_below_its_rim_is_no_board():
    volume, frame = _table()
    walls = frame.points.copy()
    walls[4000:, 2] = np.random.default_rng(1).uniform(0.0, _TOP, len(walls) - 4000)
    assert find_board(volume, ObjectFrame(np.eye(4), walls, frame.normals, True, None)) is None


@pytest.mark.parametrize("apron", [False, True])
def test_a_table_top_ends_at_its_rim_and_legs_reach_the_floor(apron):
    volume, frame = _table(apron)
    body = extract(complete(volume, frame, AssetsConfig(symmetry=False), furniture=True))
    a, b, c = (body.vertices[body.faces[:, k]] for k in range(3))
    cross, middle = np.cross(b - a, c - a), (a + b + c) / 3
    under = (cross[:, 2] < -0.9 * np.linalg.norm(cross, axis=1)) & (np.abs(middle[:, :2]) < _HALF - 0.1).all(
        axis=1
    )
    height = np.average(middle[under, 2], weights=np.linalg.norm(cross[under], axis=1))
    assert height == pytest.approx(_TOP - _THICK, abs=0.006)
    corners = np.abs(body.vertices[body.vertices[:, 2] < 0.02, :2])
    assert len(corners) > 0
    assert (corners > _HALF - _LEG - 0.01).all()


def test_known_voxels_stay():
    volume, frame = _table()
    solid = np.zeros(volume.known.shape, bool)
    decided, left = with_underside(volume, solid, find_board(volume, frame))
    np.testing.assert_array_equal(decided.distance[volume.known], volume.distance[volume.known])
    assert decided.known.sum() > volume.known.sum()
    assert not left.any()
