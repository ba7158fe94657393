"""How much of a solid lies where rays passed through: what fills a hollow that was looked into.

The surface of a table whose space below is filled is mostly that of the table, and of a block on the floor. Its volume
tells: much of what is inside of it is air that was seen through.
"""

from typing import TYPE_CHECKING

import numpy as np

from reconstruction.assets.registration import FreeDepth

if TYPE_CHECKING:
    import manifold3d

_CELLS = 64  # along the longest side


def filled_share(body: "manifold3d.Manifold", free_depth: FreeDepth, near_m: float) -> float:
    """Return the share of a body's volume that is known to be free, and lies deep inside of it.

    How deep inside the body counts, not how deep in free space: rays between legs leave lanes, with unknown between.
    Walls, boards and legs are nowhere that deep, so that what is thin is told by its surface alone.

    Args:
        body: In metres, in the space of `free_depth`.
        free_depth: Above 0 where space is known to be free.
        near_m: What is closer to the body's surface is not deep: it may be free because the body is a little off.
    """
    from scipy.ndimage import distance_transform_edt

    low, high = (np.array(body.bounding_box()[first : first + 3]) for first in (0, 3))
    cell = float((high - low).max()) / _CELLS
    inside = _cells_inside(body, low, high, cell)
    depth = (distance_transform_edt(np.pad(inside, 1))[1:-1, 1:-1, 1:-1] - 0.5) * cell
    deep = np.argwhere(inside & (depth > near_m))
    free = free_depth(low + (deep + 0.5) * cell) > 0
    return float(free.sum() / max(inside.sum(), 1))


def _cells_inside(body: "manifold3d.Manifold", low: np.ndarray, high: np.ndarray, cell: float) -> np.ndarray:
    """Return which cells (nx, ny, nz) of a box have their middles inside a body, to a sixteenth of a cell."""
    import cv2

    shape = np.ceil((high - low) / cell).astype(int)
    out = np.zeros(shape, np.uint8)
    for level in range(shape[2]):
        outlines = body.slice(float(low[2] + (level + 0.5) * cell)).to_polygons()
        at = [np.round(((outline - low[:2]) / cell - 0.5) * 16).astype(np.int32) for outline in outlines]
        section = np.zeros((shape[1], shape[0]), np.uint8)
        cv2.fillPoly(section, at, 1, cv2.LINE_8, 4)  # fixed point, four bits; even-odd
        out[:, :, level] = section.T
    return out > 0
