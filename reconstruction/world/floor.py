"""Detect the floor: the lowest large level surface that faces up, unless surface is seen below it.

Rays that pass the edge of a candidate and end lower show that it is a table top. Outliers and mirror images in a glossy
floor also lie lower, but their rays pass through the candidate, so they do not count.
"""

from dataclasses import dataclass

import numpy as np

from reconstruction.world.planes import plane_cells
from reconstruction.world.samples import SurfaceSamples

_UP = np.array([0.0, 0.0, 1.0])
_LEVEL_DEG = 14.0  # largest tilt of the normals of a level surface
_BAND_SHARE = 0.012  # half thickness of a level surface, as a share of the median depth
_CELL_SHARE = 0.05  # side of the grid cells that measure area, as a share of the median depth
_MIN_SHARE = 0.12  # smallest area of a floor, as a share of the largest level surface
_MIN_CELLS = 30  # smallest area of a floor, in cells
_BELOW_SHARE = 0.18  # a candidate with more cells below its edge than this share of its own cells is a table
_BELOW_MARGIN = 0.10  # surface counts as below from this share of the camera's height over the candidate


@dataclass(frozen=True)
class Floor:
    """The floor in upright `sfm` space (+z up, unscaled)."""

    height: float  # z of the floor if observed, else of the table, else of the lowest points
    observed: bool
    table: bool  # no floor was found, but a level surface above other surface


def find_floor(samples: SurfaceSamples) -> Floor:
    """Detect the floor in upright samples (+z up)."""
    depth = float(np.median(samples.depths))
    band, cell = _BAND_SHARE * depth, _CELL_SHARE * depth
    level = np.flatnonzero(samples.normals[:, 2] > np.cos(np.radians(_LEVEL_DEG)))
    candidates = _level_surfaces(samples, level, band, cell)
    lowest = lowest_height(samples)
    eye = float(np.median(samples.eyes[:, 2]))
    candidates = [(height, cells) for height, cells in candidates if height < eye]
    if not candidates:
        return Floor(lowest, False, False)
    largest = max(cells for _, cells in candidates)
    for height, cells in sorted(candidates):
        if cells >= max(_MIN_SHARE * largest, _MIN_CELLS):
            height = _settle(samples, level, height, band)
            below = _cells_below_edge(samples, height, _BELOW_MARGIN * (eye - height) + band, cell, band)
            if below < _BELOW_SHARE * cells:
                return Floor(height, True, False)
            # Surface is seen below: the floor is hidden, and the largest candidate is most likely a table.
            table = max(candidates, key=lambda item: item[1])[0]
            return Floor(_settle(samples, level, table, band), False, True)
    return Floor(lowest, False, False)


def lowest_height(samples: SurfaceSamples) -> float:
    """Return the 0.5 % quantile of the heights of upright samples, the measured ones if there are any."""
    points = samples.points[samples.measured] if samples.measured.any() else samples.points
    return float(np.quantile(points[:, 2], 0.005))


def _level_surfaces(
    samples: SurfaceSamples, level: np.ndarray, band: float, cell: float
) -> list[tuple[float, int]]:
    """Return (height, number of covered cells) at each peak of the histogram of level area over height."""
    if len(level) < 50:
        return []
    heights = samples.points[level, 2]
    cells = plane_cells(samples.points[level], _UP, cell)
    low = heights.min()
    layer = ((heights - low) / band).astype(np.int64)
    # Count distinct cells per layer, so that surface seen by many frames counts once.
    unique = np.unique(np.column_stack([layer, cells]), axis=0)
    counts = np.bincount(unique[:, 0], minlength=int(layer.max()) + 3).astype(float)
    smooth = np.convolve(counts, [0.5, 1.0, 0.5], mode="same")
    peaks = [
        i for i in range(len(smooth)) if smooth[i] > 0 and smooth[i] == smooth[max(i - 2, 0) : i + 3].max()
    ]
    found = []
    for i in peaks:
        near = np.abs(layer - i) <= 1
        found.append((float(np.median(heights[near])), len(np.unique(cells[near], axis=0))))
    return found


def _settle(samples: SurfaceSamples, level: np.ndarray, height: float, band: float) -> float:
    """Refine a height by the weighted median of the level samples within the band, iterated."""
    for _ in range(5):
        off = samples.points[level, 2] - height
        near = np.abs(off) < 2 * band
        weights = samples.weights[level][near] / samples.depths[level][near] ** 2
        height += float(np.quantile(off[near], 0.5, weights=weights, method="inverted_cdf"))
    return height


def _cells_below_edge(samples: SurfaceSamples, height: float, margin: float, cell: float, band: float) -> int:
    """Count the cells below a level surface that at least two frames see past its edge, not through it."""
    deep = samples.measured & (samples.points[:, 2] < height - margin)
    if not deep.any():
        return 0
    own = np.abs(samples.points[:, 2] - height) < 2 * band
    covered = plane_cells(samples.points[own], _UP, cell)
    eyes, points = samples.eyes[deep], samples.points[deep]
    share = (eyes[:, 2] - height) / np.maximum(eyes[:, 2] - points[:, 2], 1e-9)
    crossing = eyes + np.clip(share, 0, 1)[:, None] * (points - eyes)
    through = _is_near(plane_cells(crossing, _UP, cell), covered)
    seen = samples.frames[deep][~through]
    voxels = np.floor(points[~through] / cell).astype(np.int64)
    pairs = np.unique(np.column_stack([voxels, seen]), axis=0)
    _, views = np.unique(pairs[:, :3], axis=0, return_counts=True)
    return int((views >= 2).sum())


def _is_near(cells: np.ndarray, covered: np.ndarray) -> np.ndarray:
    """Return the mask (m,) of cells (m, 2) that are covered (c, 2) or next to a covered one."""
    low = np.minimum(cells.min(axis=0), covered.min(axis=0)) - 2
    size = np.maximum(cells.max(axis=0), covered.max(axis=0)) - low + 3
    if size[0] * size[1] > 50_000_000:
        # Far outliers would make the grid too large: limit it to the covered cells.
        low, size = covered.min(axis=0) - 2, np.ptp(covered, axis=0) + 5
    inside = np.all((cells >= low + 1) & (cells < low + size - 1), axis=1)
    grid = np.zeros(size, bool)
    i, j = (covered - low).T
    for di in (-1, 0, 1):
        for dj in (-1, 0, 1):
            grid[i + di, j + dj] = True
    near = np.zeros(len(cells), bool)
    near[inside] = grid[tuple((cells[inside] - low).T)]
    return near
