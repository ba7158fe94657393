"""Whether a piece of surface has a shape of its own, or is a part of the hollow of what surrounds it."""

import cv2
import numpy as np

from reconstruction.surface.mesh_graph import MeshGraph

MIN_BULGE = 0.2
_ENCLOSED = 0.9  # share of a piece that is within an outline
_SLACK_M = 0.005


def bulge(graph: MeshGraph, vertices: np.ndarray) -> float:
    """Return how normals turn outwards over a piece of surface: > 0 around a thing, 0 on a sheet, < 0 inside a bowl."""
    weight = graph.areas[vertices, None] / max(graph.areas[vertices].sum(), 1e-12)
    away = graph.points[vertices] - (weight * graph.points[vertices]).sum(axis=0)
    turn = graph.normals[vertices] - (weight * graph.normals[vertices]).sum(axis=0)
    return float((weight * away * turn).sum()) / max(float(weight[:, 0] @ np.linalg.norm(away, axis=1)), 1e-9)


def is_within(graph: MeshGraph, vertices: np.ndarray, other: np.ndarray) -> bool:
    """Return whether a piece lies within the convex outline of another one in plan."""
    hull = cv2.convexHull(graph.points[other, :2].astype(np.float32))
    flat = graph.points[vertices[:: max(1, len(vertices) // 400)], :2]
    inside = [cv2.pointPolygonTest(hull, (float(x), float(y)), True) > -_SLACK_M for x, y in flat]
    return float(np.mean(inside)) > _ENCLOSED
