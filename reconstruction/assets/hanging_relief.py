"""Height fields: objects that stand out from a wall without being flat (a wall shelf, a row of hooks).

A board seen edge-on covers too few pixels to carve it; the fused surface combines all frames. An object that hangs is
fixed to its wall, so that the space between its front and the wall is solid.
"""

from dataclasses import replace

import numpy as np
from scipy import ndimage

from reconstruction.assets.completion import CompletedField
from reconstruction.assets.config import AssetsConfig
from reconstruction.assets.solid import Solid, extract, lighten

_CELL_M, _MAX_CELLS = 0.008, 96
_FRONT_PERCENT = 90.0  # of the distances to the wall in a cell: its front
_CLOSED_CELLS = 2  # radius of the gray-scale closing
_MAX_REACH_M = 0.6
_TOLERANCE_M = 0.001  # of the decimation


def relief(points: np.ndarray, wall_y: float, config: AssetsConfig) -> Solid | None:
    """Return the solid between points (k, 3) and the wall at `wall_y`, grid frame, +y into the wall; None if empty.

    No part stands out by less than `config.flat_thickness_m`.
    """
    away = np.clip(wall_y - points[:, 1], config.flat_thickness_m, _MAX_REACH_M)
    if len(points) == 0:
        return None
    across = points[:, [0, 2]]
    start = across.min(axis=0)
    size = np.maximum(across.max(axis=0) - start, _CELL_M)
    cell = max(_CELL_M, float(size.max()) / _MAX_CELLS)
    shape = tuple(np.ceil(size / cell).astype(int))
    # The cells divide the extent exactly, so that the solid is as large as what was seen.
    steps = size / shape
    index = np.clip(np.floor((across - start) / steps).astype(int), 0, np.array(shape) - 1)
    flat = np.ravel_multi_index(index.T, shape)
    order = np.lexsort((away, flat))
    first = np.flatnonzero(np.r_[True, np.diff(flat[order]) > 0])
    count = np.diff(np.r_[first, len(flat)])
    front = np.zeros(shape)
    rank = np.floor(_FRONT_PERCENT / 100 * (count - 1)).astype(int)
    front.reshape(-1)[flat[order][first]] = away[order][first + rank]
    padded = np.pad(front, _CLOSED_CELLS)
    closed = ndimage.grey_closing(padded, size=(2 * _CLOSED_CELLS + 1,) * 2)
    front = closed[_CLOSED_CELLS:-_CLOSED_CELLS, _CLOSED_CELLS:-_CLOSED_CELLS]
    body = _between(front, start, steps, wall_y, cell)
    return None if body is None else lighten(body, config.faces_small, _TOLERANCE_M)


def mound(points: np.ndarray, config: AssetsConfig) -> Solid | None:
    """Return the solid between points (k, 3) and the support at z = 0 below them, in the grid frame; None if empty.

    For flat objects that few frames saw, at grazing angles, where carving removes too much.
    """
    laid = np.column_stack([points[:, 0], -points[:, 2], points[:, 1]])
    body = relief(laid, 0.0, replace(config, flat_thickness_m=config.min_thickness_m))
    if body is None:
        return None
    x, down, y = body.vertices.T
    return Solid(np.column_stack([x, y, -down]), body.faces)


def _between(
    front: np.ndarray, start: np.ndarray, steps: np.ndarray, wall_y: float, cell: float
) -> Solid | None:
    """Return the solid between the wall and a height field (nx, nz) of distances to it in metres, 0 = nothing."""
    layers = max(int(np.ceil(front.max() / cell)), 1)
    step_y = front.max() / layers
    depth = (np.arange(layers) + 0.5) * step_y  # distance of each layer's middle to the wall
    filled = depth[None, :, None] < front[:, None, :]
    grid = np.pad(filled, 1)
    field = CompletedField(np.zeros(3), 1.0, np.where(grid, -0.5, 0.5).astype(np.float32), ())
    body = extract(field)
    if body is None:
        return None
    # The field's unit is a cell; its y counts from the wall into the room.
    cells = body.vertices - 1.0
    vertices = np.column_stack(
        [start[0] + cells[:, 0] * steps[0], wall_y - cells[:, 1] * step_y, start[1] + cells[:, 2] * steps[1]]
    )
    return Solid(vertices, body.faces[:, ::-1].copy())
