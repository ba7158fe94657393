"""Where the floor is: the lowest large level surface that faces up, unless things are seen below it.

A table top is told from a floor by what lies below: rays that pass its edge and end lower. Wrong depth and
mirror images in a glossy floor lie below, too, but their rays pass *through* the seen floor, so they do not
count.
"""

from dataclasses import dataclass

import numpy as np

from reconstruction.world.planes import plane_cells
from reconstruction.world.samples import SurfaceSamples

_UP = np.array([0.0, 0.0, 1.0])
_LEVEL_DEG = 14.0
_BAND_SHARE = 0.012  # half thickness of a level surface, as a share of the median depth
_CELL_SHARE = 0.05
_MIN_SHARE = 0.12  # of the largest level surface: smaller ones are no floor
_MIN_CELLS = 30
_BELOW_SHARE = 0.18  # of the candidate's own cells: so much seen below its edge makes it a table
_BELOW_MARGIN = 0.10  # of the camera's height over the candidate: nearer is its own noise


@dataclass(frozen=True)
class Floor:
    """The floor in upright, unscaled space."""

    height: float  # z of the floor; else of the level surface that is `table`; else of the lowest point
    observed: bool
    table: bool  # a level surface was found, but it stands above something else


def find_floor(samples: SurfaceSamples) -> Floor:
    """Find the floor among upright samples (+z is up)."""
    depth = float(np.median(samples.depths))
    band, cell = _BAND_SHARE * depth, _CELL_SHARE * depth
    level = np.flatnonzero(samples.normals[:, 2] > np.cos(np.radians(_LEVEL_DEG)))
    candidates = _level_surfaces(samples, level, band, cell)
    lowest = float(
        np.quantile(
            samples.points[samples.measured, 2] if samples.measured.any() else samples.points[:, 2], 0.005
        )
    )
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
            # Things stand on something lower that is not seen. The largest surface is most likely a table.
            table = max(candidates, key=lambda item: item[1])[0]
            return Floor(_settle(samples, level, table, band), False, True)
    return Floor(lowest, False, False)


def _level_surfaces(
    samples: SurfaceSamples, level: np.ndarray, band: float, cell: float
) -> list[tuple[float, int]]:
    """Return (height, number of covered cells) of every peak of the level area over height."""
    if len(level) < 50:
        return []
    heights = samples.points[level, 2]
    cells = plane_cells(samples.points[level], _UP, cell)
    low = heights.min()
    layer = ((heights - low) / band).astype(np.int64)
    # Distinct cells a layer, not pixels: what many frames see counts once.
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
    """Refine the height by the weighted median of what lies within the band."""
    for _ in range(5):
        off = samples.points[level, 2] - height
        near = np.abs(off) < 2 * band
        order = np.argsort(off[near])
        total = np.cumsum(samples.weights[level][near][order] / samples.depths[level][near][order] ** 2)
        height += float(off[near][order][np.searchsorted(total, 0.5 * total[-1])])
    return height


def _cells_below_edge(samples: SurfaceSamples, height: float, margin: float, cell: float, band: float) -> int:
    """Count the cells of things below a level surface that are seen past its edge, not through it."""
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
    # Two frames must agree on a cell; what one frame alone sees is noise.
    pairs = np.unique(np.column_stack([voxels, seen]), axis=0)
    _, views = np.unique(pairs[:, :3], axis=0, return_counts=True)
    return int((views >= 2).sum())


def _is_near(cells: np.ndarray, covered: np.ndarray) -> np.ndarray:
    """Tell which cells (m, 2) are covered or next to a covered one."""
    low = np.minimum(cells.min(axis=0), covered.min(axis=0)) - 2
    size = np.maximum(cells.max(axis=0), covered.max(axis=0)) - low + 3
    if size[0] * size[1] > 50_000_000:
        # Wild outliers: look only where the surface is.
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
