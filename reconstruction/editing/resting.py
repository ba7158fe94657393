"""The height at which an object rests on what is below it: `drop_to_surface` of an overrides file."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]

from reconstruction.scene_graph.surfaces import SampledBase, SampledObject

_CELL_M = (0.006, 0.03)  # least and most side of the cells of an underside, as in `scene_graph.surfaces`
_CELLS = 24  # across the larger side of an object
_REACH_M = 0.008  # least horizontal distance at which surface counts as below a cell; twice its usual spacing
_TOUCHING = 3  # cells of first contact: fewer are spikes of a reconstructed mesh
_SUNK_M = 0.06  # flat objects are lifted out of a support from this depth: `RelationConfig.deep_sink_m`
_SAME_M = 0.01  # cells within this distance of contact tell what carries the object


@dataclass(frozen=True)
class Rest:
    """Vertical shift that lets an object rest, and its carrier."""

    shift_m: float  # along +z
    carrier: int  # id of an object or of the floor


def rest_of(
    item: SampledObject, others: Iterable[SampledObject], floors: Iterable[SampledBase]
) -> Rest | None:
    """Return how far an object moves along +z until it rests on the highest surface below it.

    Surface counts as below up to half the object's height, so that an object that is sunk in is lifted.

    Args:
        item: the object.
        others: the objects that may carry it.
        floors: the floors, without bounds.

    Returns:
        The shift and what carries it; None if nothing is below.
    """
    cells = _underside(item)
    height = item.high[2] - item.low[2]
    limit = item.low[2] + max(0.5 * height, min(height, _SUNK_M))
    carriers, tops = [], []
    for other in others:
        over = (other.high[:2] >= item.low[:2] - _REACH_M) & (other.low[:2] <= item.high[:2] + _REACH_M)
        if over.all() and len(other.up):
            carriers.append(other.id)
            tops.append(_highest_below(cells, other, limit))
    for floor in floors:
        # Height of the plane n . x + d = 0 at each cell; a floor has n nearly +z.
        level = -(cells[:, :2] @ floor.normal[:2] + floor.offset) / floor.normal[2]
        carriers.append(floor.id)
        tops.append(np.where(level <= limit, level, -np.inf))
    if not tops:
        return None
    table = np.stack(tops)
    gaps = cells[:, 2] - table.max(axis=0)
    order = np.sort(gaps[np.isfinite(gaps)])
    if not len(order):
        return None
    contact = float(order[min(_TOUCHING, len(order)) - 1])
    winners = table.argmax(axis=0)[np.isfinite(gaps) & (gaps <= contact + _SAME_M)]
    return Rest(-contact, carriers[int(np.bincount(winners).argmax())])


def _underside(item: SampledObject) -> np.ndarray:
    """Return the cells (k, 3) of the plan of an object: centers x, y, and the height of its lowest point there."""
    cell = float(np.clip((item.high - item.low)[:2].max() / _CELLS, *_CELL_M))
    index = np.floor((item.points[:, :2] - item.low[:2]) / cell).astype(np.int64)
    unique, where = np.unique(index, axis=0, return_inverse=True)
    lowest = np.full(len(unique), np.inf)
    np.minimum.at(lowest, where.ravel(), item.points[:, 2])
    return np.column_stack([(unique + 0.5) * cell + item.low[:2], lowest])


def _highest_below(cells: np.ndarray, other: SampledObject, limit: float) -> np.ndarray:
    """Return the height (k,) of the highest upward-facing surface of an object at each cell, -inf without any."""
    up = other.up[other.up[:, 2] <= limit]
    out = np.full(len(cells), -np.inf)
    if not len(up):
        return out
    near = cKDTree(up[:, :2]).query_ball_point(cells[:, :2], max(1.2 * other.spacing_m, _REACH_M))
    for row, found in enumerate(near):
        if found:
            out[row] = up[found, 2].max()
    return out
