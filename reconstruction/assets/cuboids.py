"""Boxes: solids that are one, and boxes of which only some sides were seen.

Of a box seen from one side or below other objects, carving leaves a shell, which `fit_cuboid` rejects. But its seen
points all lie on the sides of one box, and no ray passed through the inside (`unfreed_cuboid`).
"""

from collections.abc import Iterator

import numpy as np

from reconstruction.assets.solid import Solid, box_solid
from reconstruction.assets.volume import ObjectFrame, ObjectVolume

_OUTER = (0.5, 99.5)  # percentiles of the points that bound the box
_ALONG = 0.85  # least cosine between a normal and an axis
_MIN_SIZE_M = 0.008
_LEAST_POINTS, _LEAST_SHARE = 100, 0.02  # points with normals; share of them on a side
_CELLS, _COVERED = 12, 0.4  # cells of a side along each edge; least share of them with points
_FITS, _FREE = 0.88, 0.01  # least share of points on the sides; greatest share of the inside that is free
_FLAT = 0.8  # least share of axis-aligned normals: those of a cylinder are so in three of four places


def unfreed_cuboid(volume: ObjectVolume, frame: ObjectFrame, tolerance_m: float) -> Solid | None:
    """Fit an upright box (grid frame) to the seen points; None where they are not its sides or its inside is free.

    Sides along at least two axes must have been seen over much of their area. Unseen sides end where the points do.
    Points may be twice `tolerance_m` from a side.
    """
    sized = np.linalg.norm(frame.normals, axis=1) > 0.5
    points, normals = frame.points, frame.normals
    if sized.sum() < _LEAST_POINTS or (np.abs(normals[sized]).max(axis=1) > _ALONG).mean() < _FLAT:
        return None
    low, high = np.percentile(points, _OUTER, axis=0)
    if frame.on_support:
        low[2] = 0.0
    axes = _settle_sides(points, normals, low, high, tolerance_m)
    if len(axes) < 2 or (high - low).min() < _MIN_SIZE_M:
        return None
    to_sides = np.minimum(np.abs(points - low), np.abs(points - high)).min(axis=1)
    beyond = np.maximum(low - points, points - high).max(axis=1)
    fits = (to_sides < 2 * tolerance_m) & (beyond < 2 * tolerance_m)
    if fits.mean() < _FITS or _free_share(volume, low, high, volume.voxel_m + tolerance_m) > _FREE:
        return None
    return box_solid(low, high)


def fit_cuboid(points: np.ndarray, normals: np.ndarray, solid: Solid, tolerance_m: float) -> Solid | None:
    """Return an upright box on z = 0 if the completed solid is one; else None.

    Nearly all seen points (k, 3) lie on its faces, at least two besides the bottom were seen, and the solid fills it.
    Seen faces are moved to the points on them, unseen ones lie where the solid ends.
    """
    low, high = solid.bounds
    low[2] = 0.0
    if (high - low).min() < _MIN_SIZE_M:
        return None
    sized = np.linalg.norm(normals, axis=1) > 0.5
    p, n = points[sized], normals[sized]
    if len(p) < _LEAST_POINTS:
        return None
    seen = 0
    for axis, bound, on in _seen_sides(p, n, low, high, tolerance_m):
        if on.sum() > _LEAST_SHARE * len(p):
            bound[axis] = np.median(p[on, axis])
            seen += 1
    if seen < 2 or (high - low).min() < _MIN_SIZE_M:
        return None
    to_faces = np.minimum(np.abs(points - low), np.abs(points - high)).min(axis=1)
    beyond = np.maximum(np.maximum(low - points, points - high), 0).max(axis=1)
    fits = (to_faces < tolerance_m) & (beyond < tolerance_m)
    flat = np.abs(n).max(axis=1) > _ALONG
    box = box_solid(low, high)
    if fits.mean() < 0.9 or flat.mean() < 0.75 or solid.volume < 0.8 * box.volume:
        return None
    return box


def _seen_sides(
    points: np.ndarray, normals: np.ndarray, low: np.ndarray, high: np.ndarray, tolerance_m: float
) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
    """Yield the axis, the corner, and which points (k,) are on it, of each side of a box but the bottom."""
    size = high - low
    for axis, bound, way in ((0, low, -1), (0, high, 1), (1, low, -1), (1, high, 1), (2, high, 1)):
        near = np.abs(points[:, axis] - bound[axis]) < max(4 * tolerance_m, 0.1 * size[axis])
        yield axis, bound, (normals[:, axis] * way > _ALONG) & near


def _settle_sides(
    points: np.ndarray, normals: np.ndarray, low: np.ndarray, high: np.ndarray, tolerance_m: float
) -> set[int]:
    """Move the sides of a box (in place) to the points on them; return the axes with a widely seen side."""
    size, seen = high - low, set()
    for axis, bound, on in _seen_sides(points, normals, low, high, tolerance_m):
        if on.sum() < _LEAST_SHARE * len(points):
            continue
        bound[axis] = np.median(points[on, axis])
        across = [a for a in range(3) if a != axis]
        place = (points[on][:, across] - low[across]) / np.maximum(size[across], 1e-9)
        cells = np.unique(np.clip((place * _CELLS).astype(int), 0, _CELLS - 1) @ [_CELLS, 1])
        if len(cells) > _COVERED * _CELLS**2:
            seen.add(axis)
    return seen


def _free_share(volume: ObjectVolume, low: np.ndarray, high: np.ndarray, margin_m: float) -> float:
    """Return the share of a box's inside, shrunk by a margin, that is known to be free."""
    rows = [
        np.flatnonzero((volume.centers(a) > low[a] + margin_m) & (volume.centers(a) < high[a] - margin_m))
        for a in range(3)
    ]
    inside = np.ix_(*rows)
    empty = volume.known[inside] & (volume.distance[inside] > 0)
    return float(empty.mean()) if empty.size else 0.0
