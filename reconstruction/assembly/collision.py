"""Edit collision shapes: cut convex parts by a plane, flatten bumpy undersides, add legs."""

import numpy as np
from scipy.spatial import QhullError

from reconstruction.assembly.base import convex_part
from reconstruction.core.types import ConvexPart

_MIN_THICKNESS_M = 5e-4  # of a part that is kept by a cut
_LEG_M = 0.008  # side of a leg's square section
_LEG_REACH_M = 0.02  # a leg ends at the lowest vertex this near
_MIN_LEG_M = 0.01  # height


def cut(parts: tuple[ConvexPart, ...], normal: np.ndarray, offset: float) -> tuple[ConvexPart, ...]:
    """Clip convex parts to the half-space normal . x + offset >= 0; parts outside are dropped."""
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
    """Flatten the underside: cut off the lower half of a band above the lowest point, fill up its upper half.

    The shape sinks by at most half a band and its underside keeps its outline. A sphere of radius r gets a flat patch
    of radius sqrt(2 r band).

    Args:
        parts: convex parts, object space.
        up: (3,) unit, world up in object space at the pose that the shape shall stand in.
        band_m: assumed unevenness of the underside.
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
    """Add slim legs under those of the four corners of a shape that do not reach down, object space (+z up).

    Legs reach from the lowest height of the shape to its underside at the corner, inside of its outline. `parts` itself
    is returned if there is no such corner.
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
    """Return the convex hull; None if it is flat."""
    if len(points) < 4 or np.linalg.svd(points - points.mean(0), compute_uv=False)[-1] < 1e-5:
        return None
    try:
        return convex_part(points)
    except QhullError:
        return None
