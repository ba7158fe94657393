"""Collision shapes of floor, walls and ceiling: convex slabs."""

import numpy as np
from scipy.spatial import ConvexHull

from reconstruction.core.types import BaseAsset, ConvexPart

SLAB_THICKNESS_M = 0.2
FLOOR_MARGIN_M = 4.0  # beyond the visual mesh, so that nothing falls off the floor
_UNSEEN_HALF_EXTENT_M = 3.0  # of surfaces without a mesh


def base_slabs(base: BaseAsset) -> tuple[ConvexPart, ...]:
    """Return the collision shape of a base surface in world space: one box with a face exactly on the plane.

    The box covers the visual mesh and is `SLAB_THICKNESS_M` thick; that of a floor extends `FLOOR_MARGIN_M` beyond.
    """
    normal = np.asarray(base.plane[:3], np.float64)
    length = np.linalg.norm(normal)
    normal, offset = normal / length, float(base.plane[3]) / length
    # Upright in-plane axes align a wall's box with its outline.
    helper = np.array([1.0, 0, 0]) if abs(normal[2]) > 0.7 else np.array([0, 0, 1.0])
    second = helper - normal * (helper @ normal)
    second /= np.linalg.norm(second)
    first = np.cross(second, normal)
    vertices = np.asarray(base.visual.vertices, np.float64)
    if len(vertices) < 3:
        corners = [first + second, first - second, -first - second, second - first]
        vertices = _UNSEEN_HALF_EXTENT_M * np.array(corners)
    along = np.stack([vertices @ first, vertices @ second], axis=1)
    margin = FLOOR_MARGIN_M if base.label == "floor" else 0.0
    low, high = along.min(axis=0) - margin, along.max(axis=0) + margin
    high = np.maximum(high, low + 0.1)
    corners = [
        a * first + b * second + (-offset - depth) * normal
        for a in (low[0], high[0])
        for b in (low[1], high[1])
        for depth in (0.0, SLAB_THICKNESS_M)
    ]
    return (convex_part(np.array(corners)),)


def convex_part(points: np.ndarray) -> ConvexPart:
    """Return the convex hull of points (n, 3); faces are counter-clockwise seen from outside."""
    hull = ConvexHull(points)
    index = np.full(len(points), -1)
    index[hull.vertices] = np.arange(len(hull.vertices))
    faces = index[hull.simplices]
    corners = points[hull.simplices]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inward = np.einsum("ij,ij->i", cross, hull.equations[:, :3]) < 0
    faces[inward] = faces[inward][:, ::-1]
    return ConvexPart(points[hull.vertices].astype(np.float32), faces.astype(np.int32))
