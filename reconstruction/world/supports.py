"""Measure the evidence for metres in upright samples: level surfaces above the floor, and the highest seen point."""

from dataclasses import dataclass

import cv2
import numpy as np
from scipy import ndimage

from reconstruction.world.samples import SurfaceSamples

_LEVEL_DEG = 14.0  # largest tilt of the normals, as for the floor
_BAND_SHARE = 0.012  # thickness of a height layer, as a share of the median depth, as for the floor
_CELL_SHARE = 0.025  # side of the grid cells, as a share of the median depth
_MIN_CELLS = 12  # smaller patches are the tops of things
_MIN_AREA_SHARE = 0.03  # smallest area of the surfaces at one height, as a share of the squared camera height
_SAME_HEIGHT = 0.03  # relative: surfaces of one height count once (a set of chairs, a split table top)
_TOP_QUANTILE = 0.995  # the remaining points may be outliers


@dataclass(frozen=True)
class SupportSurface:
    """Level surface at one height above the floor, in `sfm` units; extents are those of its largest piece."""

    height: float
    area: float
    long: float
    short: float


def measure_supports(samples: SurfaceSamples, floor_height: float, eye_height: float) -> list[SupportSurface]:
    """Measure the level surfaces above the floor in upright samples, the largest first.

    Args:
        samples: upright (+z up), `sfm` units.
        floor_height: z of the floor.
        eye_height: of the camera above the floor.
    """
    depth = float(np.median(samples.depths))
    band, cell = _BAND_SHARE * depth, _CELL_SHARE * depth
    level = samples.normals[:, 2] > np.cos(np.radians(_LEVEL_DEG))
    heights = samples.points[:, 2] - floor_height
    rows = np.flatnonzero(level & (heights > 3 * band))
    if len(rows) < 50:
        return []
    pieces = _pieces(heights[rows], np.floor(samples.points[rows, :2] / cell).astype(np.int64), band, cell)
    groups: list[SupportSurface] = []
    for piece in sorted(pieces, key=lambda p: -p.area):
        for i, group in enumerate(groups):
            if abs(np.log(piece.height / group.height)) < _SAME_HEIGHT:
                total = group.area + piece.area
                groups[i] = SupportSurface(group.height, total, group.long, group.short)
                break
        else:
            groups.append(piece)
    groups = [g for g in groups if g.area >= _MIN_AREA_SHARE * eye_height**2]
    return sorted(groups, key=lambda g: -g.area)


def highest_point(samples: SurfaceSamples, floor_height: float) -> float:
    """Return the height above the floor below which nearly all measured upright samples lie."""
    points = samples.points[samples.measured] if samples.measured.any() else samples.points
    return float(np.quantile(points[:, 2], _TOP_QUANTILE)) - floor_height


def _pieces(heights: np.ndarray, cells: np.ndarray, band: float, cell: float) -> list[SupportSurface]:
    """Return the connected pieces of each height layer (heights (m,), cells (m, 2)), the fullest layers first."""
    layer = (heights / band).astype(np.int64)
    # Distinct cells per layer: surface seen by many frames counts once.
    distinct = np.unique(np.column_stack([layer, cells]), axis=0)
    counts = np.bincount(distinct[:, 0], minlength=int(layer.max()) + 3).astype(float)
    smooth = np.convolve(counts, [0.5, 1.0, 0.5], mode="same")
    used, found = np.zeros(len(heights), bool), []
    for peak in np.argsort(-smooth, kind="stable"):
        if smooth[peak] < _MIN_CELLS:
            break
        near = (np.abs(layer - peak) <= 1) & ~used
        if near.sum() < 20:
            continue
        used |= near
        found += _connected(heights[near], cells[near], cell)
    return found


def _connected(heights: np.ndarray, cells: np.ndarray, cell: float) -> list[SupportSurface]:
    """Return the connected pieces of one layer that are large enough."""
    corner = cells.min(axis=0)
    grid = np.zeros(cells.max(axis=0) - corner + 1, bool)
    grid[tuple((cells - corner).T)] = True
    closed = ndimage.binary_closing(np.pad(grid, 2), np.ones((3, 3)))[2:-2, 2:-2] | grid
    count, labels = cv2.connectedComponents(closed.astype(np.uint8), connectivity=8)
    of_point = labels[tuple((cells - corner).T)]
    found = []
    for number in range(1, count):
        own = np.argwhere(labels == number)
        if len(own) < _MIN_CELLS:
            continue
        _, sides, _ = cv2.minAreaRect(own.astype(np.float32))
        short, long = sorted((side + 1) * cell for side in sides)
        height = float(np.median(heights[of_point == number]))
        found.append(SupportSurface(height, len(own) * cell**2, long, short))
    return found
