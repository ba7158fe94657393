"""Share of a solid that is free space: rejects meshes that fill a hollow which rays passed through.

Most of the surface of a table whose space below is filled belongs to the table or to a block on the floor, so that the
surface does not tell. The volume does.
"""

from typing import TYPE_CHECKING

import numpy as np

from reconstruction.assets.registration import FreeDepth
from reconstruction.assets.solid import raster_section

if TYPE_CHECKING:
    import manifold3d

_CELLS = 64  # along the longest side


def filled_share(body: "manifold3d.Manifold", free_depth: FreeDepth, near_m: float) -> float:
    """Return the share of a body's volume that is free and deeper inside the body than `near_m`.

    Depth in the body counts, not depth in free space, as rays between legs free narrow lanes only. Walls, boards and
    legs are nowhere that deep.

    Args:
        body: in metres, in the frame of `free_depth`.
        free_depth: above 0 where space is known to be free.
        near_m: tolerance for a body that is slightly displaced.
    """
    from scipy.ndimage import distance_transform_edt

    low, high = (np.array(body.bounding_box()[first : first + 3]) for first in (0, 3))
    cell = float((high - low).max()) / _CELLS
    inside = _cells_inside(body, low, high, cell)
    edges = np.asarray(distance_transform_edt(np.pad(inside, 1)))[1:-1, 1:-1, 1:-1]
    depth = (edges - 0.5) * cell
    deep = np.argwhere(inside & (depth > near_m))
    free = free_depth(low + (deep + 0.5) * cell) > 0
    return float(free.sum() / max(inside.sum(), 1))


def _cells_inside(body: "manifold3d.Manifold", low: np.ndarray, high: np.ndarray, cell: float) -> np.ndarray:
    """Return which cells (nx, ny, nz) of a box have their centers inside a body, to a sixteenth of a cell."""
    shape = np.ceil((high - low) / cell).astype(int)
    out = np.zeros(shape, np.uint8)
    for level in range(shape[2]):
        height = float(low[2] + (level + 0.5) * cell)
        out[:, :, level] = raster_section(body, height, low[:2], cell, -0.5, shape[:2]).T
    return out > 0
