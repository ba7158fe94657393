"""Edits of collision shapes: cut by a plane, give a flat foot (reconstructed undersides are bumpy)."""

import numpy as np
from scipy.spatial import QhullError

from reconstruction.assembly.base import convex_part
from reconstruction.core.types import ConvexPart

_MIN_THICKNESS_M = 5e-4
_LEG_M = 0.008
_LEG_REACH_M = 0.02  # a leg ends at the lowest piece this near
_MIN_LEG_M = 0.01


def cut(parts: tuple[ConvexPart, ...], normal: np.ndarray, offset: float) -> tuple[ConvexPart, ...]:
    """Keep what lies at normal . x + offset >= 0 of every piece; pieces wholly behind vanish."""
    out = []
    for part in parts:
        points = np.asarray(part.vertices, np.float64)
        side = points @ normal + offset
        if side.min() >= 0:
            out.append(part)
            continue
        if side.max() < _MIN_THICKNESS_M:
            continue
        faces = np.asarray(part.faces)
        a = np.concatenate([faces[:, 0], faces[:, 1], faces[:, 2]])
        b = np.concatenate([faces[:, 1], faces[:, 2], faces[:, 0]])
        crossing = (side[a] > 0) & (side[b] < 0)
        a, b = a[crossing], b[crossing]
        t = (side[a] / (side[a] - side[b]))[:, None]
        made = _hull(np.concatenate([points[side >= 0], points[a] + t * (points[b] - points[a])]))
        if made is not None:
            out.append(made)
    return tuple(out)


def flatten_foot(parts: tuple[ConvexPart, ...], up: np.ndarray, band_m: float) -> tuple[ConvexPart, ...]:
    """Give the shape a level foot: bumps in the lowest half band go, the band above is filled in.

    Args:
        parts: convex pieces, object space.
        up: (3,) unit, the world's up in object space at the pose that the shape shall stand in.
        band_m: how uneven the underside is taken to be.

    Cutting and filling meet in the middle, so that the shape sinks by at most half a band and its foot keeps
    its outline. A sphere of radius r gets a flat patch of radius sqrt(2 r band).
    """
    heights = [np.asarray(part.vertices, np.float64) @ up for part in parts]
    level = min(h.min() for h in heights) + 0.5 * band_m
    cut_parts = cut(parts, up, -level)
    if not cut_parts:
        return parts
    out = []
    for part in cut_parts:
        points = np.asarray(part.vertices, np.float64)
        height = points @ up - level
        low = (height > 1e-6) & (height <= band_m)
        if height.min() > band_m or not low.any():
            out.append(part)
            continue
        made = _hull(np.concatenate([points, points[low] - height[low, None] * up]))
        out.append(part if made is None else made)
    return tuple(out)


def with_legs(parts: tuple[ConvexPart, ...]) -> tuple[ConvexPart, ...]:
    """Add slim legs below the four corners of a shape that stand in the air, object space (+z up).

    They reach from the shape's lowest height to its underside at the corner, and stay within its outline. A shape
    whose corners all reach down is returned as it is.
    """
    points = np.concatenate([np.asarray(part.vertices, np.float64) for part in parts])
    low, middle = points[:, 2].min(), 0.5 * (points.min(axis=0) + points.max(axis=0))[:2]
    legs = []
    for toward in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
        corner = points[np.argmax(points[:, :2] @ np.array(toward)), :2]
        inward = np.sign(middle - corner)
        center = corner + 0.5 * _LEG_M * inward
        near = np.abs(points[:, :2] - center).max(axis=1) < _LEG_REACH_M
        underside = points[near, 2].min()
        if underside - low < _MIN_LEG_M:
            continue
        x, y = (center[axis] + 0.5 * _LEG_M * np.array([-1, 1]) for axis in range(2))
        legs.append(convex_part(np.array([(a, b, c) for a in x for b in y for c in (low, underside)])))
    return (*parts, *legs) if legs else parts


def _hull(points: np.ndarray) -> ConvexPart | None:
    """Return the hull, or None where what is left has no volume worth keeping."""
    if len(points) < 4 or np.linalg.svd(points - points.mean(0), compute_uv=False)[-1] < 1e-5:
        return None
    try:
        return convex_part(points)
    except QhullError:
        return None
