"""Containment in hollows, and distances within an outline, checked against geometry."""

import cv2
import numpy as np
import pytest
from fused_surfaces import box, can, fused, tray

from reconstruction.core.mesh_graph import MeshGraph
from reconstruction.instances.containment import inset, is_inside

WOOD, RED = (205, 170, 115), (190, 30, 30)
TABLE = box((-0.4, -0.35, 0.0), (0.4, 0.35, 0.4), (120, 80, 50))


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


def test_what_is_in_a_container_goes_on_behind_the_rim():
    """A can in a basket, seen from 6 cm above the bottom on; the basket's inner sides are seen lower than that."""
    basket = tray((-0.15, -0.1, 0.0), (0.15, 0.1, 0.1), 0.018, WOOD)
    surface = fused([*basket, can((0.03, 0.0), 0.035, 0.018, 0.16, RED)], half_m=0.25, top_m=0.3)
    graph = MeshGraph.from_surface(surface)
    above = graph.points[:, 2] > 0.002
    on_can = np.hypot(graph.points[:, 0] - 0.03, graph.points[:, 1]) < 0.045
    hidden = (graph.points[:, 2] < 0.06) & (np.hypot(graph.points[:, 0] - 0.03, graph.points[:, 1]) < 0.06)
    inner = np.flatnonzero(on_can & ~hidden & above)
    container = np.flatnonzero(~on_can & ~hidden & above)
    assert is_inside(graph, container, inner, 0.06)
    # On its bottom, which is seen all around, it is not hidden; nor on a table without a rim.
    whole = np.flatnonzero(on_can & (graph.points[:, 2] > 0.024))
    assert not is_inside(graph, np.flatnonzero(~on_can & above), whole, 0.024)
    table = fused([TABLE, can((0.0, 0.0), 0.035, 0.4, 0.5, RED)], half_m=0.45, top_m=0.6)
    graph = MeshGraph.from_surface(table)
    low = graph.points[:, 2] < 0.404
    assert not is_inside(graph, np.flatnonzero(low), np.flatnonzero(~low), 0.404)
