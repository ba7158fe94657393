"""Boxes of which only some sides were seen: what no ray passed through between flat sides is taken to be full.

`solid.fit_cuboid` asks that the completed solid fills its box. Of a box seen from one side or below other things,
carving leaves a shell; but its seen points all lie on the sides of one box, and nothing within was seen free.
"""

import numpy as np

from reconstruction.assets.solid import Solid, box_solid
from reconstruction.assets.volume import ObjectFrame, ObjectVolume

_OUTER = (0.5, 99.5)  # percentiles
_ALONG = 0.85  # cosine
_MIN_SIZE_M = 0.008
_LEAST_POINTS, _LEAST_SHARE = 100, 0.02
_CELLS, _COVERED = 12, 0.4  # of a side's cells along each edge; share of them with points
_FITS, _FLAT, _FREE = 0.88, 0.8, 0.01  # a cylinder's normals lie along its box in three of four places


def unfreed_cuboid(volume: ObjectVolume, frame: ObjectFrame, tolerance_m: float) -> Solid | None:
    """Return the upright box (grid frame) on whose sides what was seen lies, if nothing within it was seen free.

    Sides along two axes at least must have been seen, each over much of its area. Unseen ones end where points do.

    Args:
        volume: the evidence.
        frame: with the seen points.
        tolerance_m: of points beside a side; twice that is allowed.
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


def _settle_sides(
    points: np.ndarray, normals: np.ndarray, low: np.ndarray, high: np.ndarray, tolerance_m: float
) -> set[int]:
    """Move the sides of a box (in place) to the points on them; return the axes of those that were seen widely."""
    size, seen = high - low, set()
    for axis in range(3):
        across = [a for a in range(3) if a != axis]
        for bound, way in ((low, -1), (high, 1)):
            near = np.abs(points[:, axis] - bound[axis]) < max(4 * tolerance_m, 0.1 * size[axis])
            on = (normals[:, axis] * way > _ALONG) & near
            if (axis == 2 and way < 0) or on.sum() < _LEAST_SHARE * len(points):
                continue
            bound[axis] = np.median(points[on, axis])
            place = (points[on][:, across] - low[across]) / np.maximum(size[across], 1e-9)
            cells = np.unique(np.clip((place * _CELLS).astype(int), 0, _CELLS - 1) @ [_CELLS, 1])
            if len(cells) > _COVERED * _CELLS**2:
                seen.add(axis)
    return seen


def _free_share(volume: ObjectVolume, low: np.ndarray, high: np.ndarray, margin_m: float) -> float:
    """Return the share of a box's inside that is known to be empty."""
    rows = [
        np.flatnonzero((volume.centers(a) > low[a] + margin_m) & (volume.centers(a) < high[a] - margin_m))
        for a in range(3)
    ]
    inside = np.ix_(*rows)
    empty = volume.known[inside] & (volume.distance[inside] > 0)
    return float(empty.mean()) if empty.size else 0.0
