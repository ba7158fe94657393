"""World height of the support right below an object, measured around the object."""

import numpy as np

from reconstruction.assets.views import SeenPoints
from reconstruction.core.types import Instance, InstanceSet

_RING_M = (0.025, 0.06)  # distance from the footprint: nearer, the object's depth bleeds onto the support
_BLEED_HEIGHT_M = 0.03  # greatest height of that slope
_LEVEL_M = 0.003  # tolerance of a flat support


def support_height(
    item: Instance, points: np.ndarray, carrier: SeenPoints | None, found: InstanceSet
) -> float | None:
    """Return the world height of the support right below an object with points (k, 3); None where it is not known.

    A floor is a plane. Other supports are measured: their points (`carrier`) in a ring around the footprint.
    """
    lowest = float(np.percentile(points[:, 2], 0.5))
    height = float(np.percentile(points[:, 2], 99.5)) - lowest
    for base in found.base:
        if base.id == item.support_hint and base.label == "floor":
            n, d = base.surface.plane[:3], base.surface.plane[3]
            center = np.median(points[:, :2], axis=0)
            level = float(-(d + n[:2] @ center) / n[2]) if abs(n[2]) > 0.5 else 0.0
            return level if level < lowest + 0.05 else None
    if carrier is None:
        return None
    ring = _support_ring(points, carrier)
    if len(ring) < 30:
        return None
    level = float(np.percentile(ring, 30))
    # A rim around the object (a tray) is higher than what it stands on: take the low part.
    if level > lowest + 0.01:
        level = float(np.percentile(ring, 8))
    if level > lowest + 0.02 or lowest - level > max(0.04, 0.6 * height):
        return None
    around = _level_around(points, carrier)
    # Bleeding turns a flat support into a slope of a few centimetres around the object: take the foot of the slope.
    if around is not None and level - _BLEED_HEIGHT_M < around < level:
        level = around
    return min(level, lowest + 0.004)


def _level_around(points: np.ndarray, support: SeenPoints) -> float | None:
    """Return the height of the flat support a few centimetres from an object; None: not flat, or not all around it."""
    low, high = points[:, :2].min(axis=0) - _RING_M[1], points[:, :2].max(axis=0) + _RING_M[1]
    inside = np.all((support.points[:, :2] > low) & (support.points[:, :2] < high), axis=1)
    near = support.points[inside & (support.normals[:, 2] > 0.7)]
    if len(near) < 60:
        return None
    away = _footprint_distance(points, near)
    ring = near[(away > _RING_M[0]) & (away < _RING_M[1])]
    offset = ring[:, :2] - np.median(points[:, :2], axis=0)
    sector = np.floor((np.arctan2(offset[:, 1], offset[:, 0]) / np.pi + 1) * 6).astype(int) % 12
    heights = [np.median(ring[sector == k, 2]) for k in range(12) if (sector == k).sum() >= 5]
    if len(heights) < 6:
        return None
    level = float(np.median(heights))
    agree = np.abs(np.array(heights) - level) < _LEVEL_M
    return level if agree.mean() >= 0.75 else None


def _footprint_distance(points: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Return the distance (n,) of points `near` to an object's points, seen from above."""
    from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]

    return cKDTree(points[:: max(1, len(points) // 5000), :2]).query(near[:, :2])[0]


def _support_ring(points: np.ndarray, support: SeenPoints) -> np.ndarray:
    """Return heights (k,) of the support within 1.2, 2.5 or 4 cm of the object: the nearest with 60 points."""
    if len(support.points) == 0:
        return np.zeros(0)
    low, high = points[:, :2].min(axis=0) - 0.04, points[:, :2].max(axis=0) + 0.04
    upward = (support.normals[:, 2] > 0.7) | (np.linalg.norm(support.normals, axis=1) < 0.5)
    inside = np.all((support.points[:, :2] > low) & (support.points[:, :2] < high), axis=1) & upward
    near = support.points[inside]
    if len(near) < 30:
        return np.zeros(0)
    distance = _footprint_distance(points, near)
    for reach in (0.012, 0.025, 0.04):
        ring = near[distance < reach, 2]
        if len(ring) >= 60:
            return ring
    return near[:, 2]
