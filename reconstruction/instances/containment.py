"""Containment: test whether one object lies in the hollow of another."""

import cv2
import numpy as np
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]

from reconstruction.core.mesh_graph import MeshGraph

_ENCLOSED, _SLACK_M = 0.9, 0.005  # share of the vertices inside a footprint, up to this far outside of it
_RIM_M, _AROUND_M = 0.15, 0.3  # largest height of the rim over the inner object's bottom, and its distance
_DEEPER_M = 0.01  # inside the rim, and below the inner object's bottom
_MIN_LOWER_M2, _LOWER_RATIO = 2e-4, 2.0  # least area below that bottom, and over the area level with it
_LEVEL = 0.8  # least z of the normals of level surface
_SECTORS, _MIN_SECTORS = 8, 7  # directions around the inner object, and how many of them must meet the rim


def is_within(graph: MeshGraph, vertices: np.ndarray, other: np.ndarray) -> bool:
    """Return whether the vertices lie within the convex footprint of the vertices `other`."""
    hull = cv2.convexHull(graph.points[other, :2].astype(np.float32))
    flat = graph.points[vertices[:: max(1, len(vertices) // 400)], :2]
    return float(np.mean(inset(hull, flat) > -_SLACK_M)) > _ENCLOSED


def is_inside(graph: MeshGraph, container: np.ndarray, inner: np.ndarray, bottom: float) -> bool:
    """Return whether an object is in a hollow of a container that continues below the object's visible bottom.

    The container has a rim around the object in nearly all directions in plan, and inside the rim more up-facing area
    below the height `bottom` than at it.

    Args:
        graph: the surface.
        container: int (n,) vertices.
        inner: int (m,) vertices of the object.
        bottom: height at which the visible surface of the object ends, metres.
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
    """Return the signed distances float64 (n,) of points (n, 2) to a polygon, positive inside.

    Args:
        outline: float32 (k, 1, 2) or (k, 2) corners in order, such as `cv2.convexHull` returns.
        points_xy: (n, 2), rounded to float32 as the corners are.
    """
    points = np.asarray(points_xy, np.float64).tolist()
    return np.array([cv2.pointPolygonTest(outline, (x, y), True) for x, y in points], np.float64)
