"""Where two touching things of different colors meet, seen from above.

A low thing beside a tall one, or a small one beside a large one, has no waist from both sides. But what is on either
side of the place where they meet has hardly a color in common, and together they have a bay in their outline that
neither has alone, or level tops of two heights. One thing of two colors has no such bay and no such step, and handles
and spouts are of the thing's own colors.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from scipy import ndimage

from reconstruction.instances.boxes import quantiles
from reconstruction.instances.colors import LIGHTNESS_WEIGHT
from reconstruction.instances.image_colors import SurfaceSamples
from reconstruction.instances.outlines import filled_hull
from reconstruction.instances.patches import palette

_CELL_M = 0.01
_STEP_M, _AXES = 0.01, np.radians(np.arange(0.0, 180.0, 15.0))
_CLEAR = 0.3  # of the height: below it are skirts, and the colors of the ground
_FOOT_M = 0.005  # above it, what goes on across a line is no ground
_COLORS, _COLOR_GAP = 16, 6.0
_MOST_COMMON = 0.3  # share of either side's area whose color the other side has, too
_LEAST_SHARE = 0.12  # of the whole on either side
_SOLID, _BAY = 0.93, 0.025  # of the hull of each side; and more than of the hull of both
_BLOCK, _STEP_UP_M = 0.9, 0.015  # solidity of what has a level top, and a step between two tops
_LEVEL, _TOP_M, _TOP_SHARE = 0.7, 0.006, 0.33  # of a top: z of normals, half its spread, share of the hull
_MIN_SAMPLES, _MOST_SAMPLES = 200, 3000
_MIN_SIDE = 40  # samples
_GROUND_M = 0.025  # both stand on the same


def meeting_line(
    points: np.ndarray, areas: np.ndarray, samples: SurfaceSamples
) -> tuple[np.ndarray, float] | None:
    """Return the line across which two things touch: a unit axis (2,) and the place along it in metres.

    Args:
        points: float64 (n, 3) vertices of what may be two things.
        areas: float64 (n,) theirs.
        samples: of the same, with colors.

    Returns:
        None where there is one thing.
    """
    bottom, top = quantiles(points[:, 2], areas, (0.01, 0.99))
    clear = bottom + _CLEAR * (top - bottom)
    line = _least_common(samples.of(np.isfinite(samples.lab[:, 0]) & (samples.points[:, 2] > clear)))
    if line is None:
        return None
    axis, at = line
    first, high = points[:, :2] @ axis < at, points[:, 2] > clear
    for side in (first, ~first):
        if not (side & high).any() or points[side, 2].min() > bottom + _GROUND_M:
            return None
    if _goes_across(samples, axis, at, (bottom + _FOOT_M, clear)):
        return None
    solid = min(solidity(points[side & high, :2]) for side in (first, ~first))
    bay = solid >= _SOLID and solid - solidity(points[high, :2]) >= _BAY
    return (axis, at) if bay or (solid >= _BLOCK and _steps(samples, axis, at, clear)) else None


def _goes_across(samples: SurfaceSamples, axis: np.ndarray, at: float, between: tuple[float, float]) -> bool:
    """Tell whether something low, between two heights, has the same colors on both sides of a line: a tray under it."""
    seen = samples.of(np.isfinite(samples.lab[:, 0]) & (samples.points[:, 2] > between[0]))
    paint, low = Paint.of(seen), seen.points[:, 2] < between[1]
    first = seen.points[:, :2] @ axis < at
    shared = np.minimum(paint.area(low & first), paint.area(low & ~first)).sum()
    return bool(shared > _LEAST_SHARE * seen.areas[~low].sum())


def _least_common(samples: SurfaceSamples) -> tuple[np.ndarray, float] | None:
    """Return the line whose sides have least color in common, None where that is too much."""
    if len(samples.points) < _MIN_SAMPLES:
        return None
    paint = Paint.of(samples)
    whole = paint.area(np.ones(len(samples.points), bool))
    best, line = _MOST_COMMON, None
    for angle in _AXES:
        axis = np.array([np.cos(angle), np.sin(angle)])
        along = samples.points[:, :2] @ axis
        low, high = np.percentile(along, [1, 99])
        for at in np.arange(low + 3 * _STEP_M, high - 3 * _STEP_M, _STEP_M):
            side = along < at
            one = paint.area(side)
            two = whole - one
            share = one.sum() / whole.sum()
            if min(share, 1.0 - share) < _LEAST_SHARE:
                continue
            common = float(np.minimum(one / one.sum(), two / two.sum()).sum())
            if common < best:
                best, line = common, (axis, float(at))
    return line


@dataclass(frozen=True)
class Paint:
    """The typical color of each of some samples.

    Args:
        color: int (n,) its number.
        areas: float64 (n,) of the samples, in square metres.
        count: how many typical colors there are.
    """

    color: np.ndarray
    areas: np.ndarray
    count: int

    @classmethod
    def of(cls, samples: SurfaceSamples) -> "Paint":
        """Return the paint of samples that all have a color."""
        lab = samples.lab * LIGHTNESS_WEIGHT
        means = palette(lab[:: max(1, len(lab) // _MOST_SAMPLES)], _COLORS, _COLOR_GAP)[1]
        return cls(
            np.argmin(((lab[:, None] - means[None]) ** 2).sum(axis=2), axis=1), samples.areas, len(means)
        )

    def area(self, rows: np.ndarray) -> np.ndarray:
        """Return how much area (count,) of some samples (mask) is of each color."""
        return np.bincount(self.color[rows], weights=self.areas[rows], minlength=self.count)

    def common(self, side: np.ndarray) -> float:
        """Return the share of the area of samples on one side (mask) and the other that is of colors that both have.

        1 where either side is too little to tell.
        """
        if min(side.sum(), (~side).sum()) < _MIN_SIDE:
            return 1.0
        one, two = self.area(side), self.area(~side)
        return float(np.minimum(one / one.sum(), two / two.sum()).sum())


def _steps(samples: SurfaceSamples, axis: np.ndarray, at: float, clear: float) -> bool:
    """Tell whether both sides of a line have level tops, of two heights."""
    first, high = samples.points[:, :2] @ axis < at, samples.points[:, 2] > clear
    tops = [_level_top(samples.of(side & high)) for side in (first, ~first)]
    return None not in tops and abs(tops[0] - tops[1]) > _STEP_UP_M


def _level_top(samples: SurfaceSamples) -> float | None:
    """Return the height at which most of what faces up is, None where it covers too little of the outline."""
    up = samples.normals[:, 2] > _LEVEL
    if not up.any():
        return None
    z, areas = samples.points[up, 2], samples.areas[up]
    height = quantiles(z, areas, (0.5,))[0]
    level = areas[np.abs(z - height) < _TOP_M].sum()
    hull = cv2.contourArea(cv2.convexHull(samples.points[:, :2].astype(np.float32)))
    return float(height) if level > _TOP_SHARE * hull else None


def solidity(flat: np.ndarray) -> float:
    """Return how much of the convex hull of points (n, 2) they cover."""
    cells = np.floor((flat - flat.min(axis=0)) / _CELL_M).astype(int) + 2
    mask = np.zeros(cells.max(axis=0) + 3, bool)
    mask[tuple(cells.T)] = True
    mask = ndimage.binary_fill_holes(ndimage.binary_closing(mask, np.ones((3, 3))))
    return float(mask.sum() / max(filled_hull(mask).sum(), 1))
