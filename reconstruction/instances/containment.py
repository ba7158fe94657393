"""Containment: whether one thing lies in the hollow of another."""

import cv2
import numpy as np
from scipy.spatial import cKDTree

from reconstruction.core.mesh_graph import MeshGraph

_ENCLOSED = 0.9  # share of a piece that is within an outline
_SLACK_M = 0.005
_RIM_M, _AROUND_M = 0.15, 0.3  # a container's rim above the end of what is in it, and around that
_DEEPER_M, _MIN_LOWER_M2 = 0.01, 2e-4
_LEVEL, _LOWER_RATIO = 0.8, 2.0
_SECTORS, _MIN_SECTORS = 8, 7  # directions around a thing, and how many of them meet the rim


def is_within(graph: MeshGraph, vertices: np.ndarray, other: np.ndarray) -> bool:
    """Return whether a piece lies within the convex outline of another one in plan."""
    hull = cv2.convexHull(graph.points[other, :2].astype(np.float32))
    flat = graph.points[vertices[:: max(1, len(vertices) // 400)], :2]
    return float(np.mean(inset(hull, flat) > -_SLACK_M)) > _ENCLOSED


def is_inside(graph: MeshGraph, container: np.ndarray, inner: np.ndarray, bottom: float) -> bool:
    """Return whether a piece is in a hollow that goes on below what is seen of the piece, which ends at z = `bottom`.

    A rim stands around it, nearly all around in plan, and within the rim more is seen lower than level with its end.
    """
    if not is_within(graph, inner, container):
        return False
    height = graph.points[container, 2] - bottom
    rim = graph.points[container[(height > 0) & (height < _RIM_M)], :2]
    if len(rim) < _SECTORS:
        return False
    own = graph.points[inner, :2]
    rim = rim[cKDTree(own).query(rim)[0] < _AROUND_M]
    offset = rim - np.median(own, axis=0)
    sector = np.floor((np.arctan2(offset[:, 1], offset[:, 0]) / (2 * np.pi) + 0.5) * _SECTORS).astype(int)
    if len(np.unique(sector % _SECTORS)) < _MIN_SECTORS:
        return False
    hull = cv2.convexHull(rim.astype(np.float32))
    within = np.zeros(len(container), bool)
    near = np.flatnonzero(np.abs(height) < _RIM_M)
    within[near] = inset(hull, graph.points[container[near], :2]) > _DEEPER_M
    up, area = graph.normals[container, 2], graph.areas[container]
    lower = area[within & (height < -_DEEPER_M) & (up > 0.0)].sum()
    level = area[within & (np.abs(height) < _DEEPER_M) & (up > _LEVEL)].sum()
    return bool(lower > max(_MIN_LOWER_M2, _LOWER_RATIO * level))


def inset(outline: np.ndarray, points_xy: np.ndarray) -> np.ndarray:
    """Return how far points are within an outline in plan, in meters; negative outside of it.

    Args:
        outline: float32 (k, 1, 2) or (k, 2) corners of a polygon in order, such as `cv2.convexHull` returns.
        points_xy: (n, 2), rounded to float32 as the corners are.

    Returns:
        float64 (n,) distance to the nearest side.
    """
    points = np.asarray(points_xy, np.float64).tolist()
    return np.array([cv2.pointPolygonTest(outline, (x, y), True) for x, y in points], np.float64)
