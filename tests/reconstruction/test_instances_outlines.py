"""Distances within an outline, checked against geometry."""

import cv2
import numpy as np
import pytest

from reconstruction.instances.outlines import inset


def test_inset_of_a_rectangle_is_the_distance_to_its_nearest_side():
    corners = np.array([[1, 2], [1.4, 2], [1.4, 2.2], [1, 2.2]], np.float32)
    points = np.array([[1.2, 2.1], [1.03, 2.1], [1.4, 2.1], [1.5, 2.1], [1.43, 2.24]])
    assert inset(corners, points) == pytest.approx([0.1, 0.03, 0, -0.1, -0.05], abs=1e-6)


def test_inset_in_a_hull_is_the_least_distance_to_the_lines_of_its_sides():
    rng = np.random.default_rng(0)
    hull = cv2.convexHull(rng.normal(0, 0.2, (30, 2)).astype(np.float32))
    start = hull[:, 0].astype(np.float64)
    side = np.roll(start, -1, axis=0) - start
    points = 0.3 * start + 0.7 * start.mean(axis=0)
    offset = points[:, None] - start
    away = np.abs(side[:, 0] * offset[..., 1] - side[:, 1] * offset[..., 0]) / np.linalg.norm(side, axis=1)
    assert inset(hull, points) == pytest.approx(away.min(axis=1), abs=1e-6)


def test_no_points_have_no_insets():
    assert inset(np.zeros((4, 1, 2), np.float32), np.zeros((0, 2))).shape == (0,)
