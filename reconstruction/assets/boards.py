"""Underside of a table top: its thickness is measured at its rim.

Depth reaches a few centimetres into a table top from above, and the space below it is unknown: completion would fill it
between aprons and legs, or leave the top a thin sheet. The rim and the free space below it were seen all around.
"""

from dataclasses import dataclass, replace

import numpy as np

from reconstruction.assets.volume import ObjectFrame, ObjectVolume

_UP = 0.85  # least z of an upward normal
_LEAST_SHARE = 0.25  # of the object's footprint that the board covers
_LEAST_HEIGHT = 0.85  # of the object's height: only boards above that are tops
_RIM_M = 0.02  # half width of the rim, seen from above
_MOST_M = 0.12  # thickness of a board
_BIN_M, _USUAL_BIN = (
    0.005,
    1,
)  # histogram of depth below the top; its first bin is skipped, as the edge is round
_FEW, _LEAST_POINTS = 0.2, 30  # share of the usual bin's points that ends the rim; least points of that bin
_BELOW_M = 0.06  # height below the board that is emptied; what continues farther down is a leg or a box


@dataclass(frozen=True)
class Board:
    """A level board with free space below its rim."""

    plan: np.ndarray  # bool (nx, ny) columns
    top_m: float  # grid frame
    thickness_m: float


def find_board(volume: ObjectVolume, frame: ObjectFrame) -> Board | None:
    """Return the topmost large level board of an object; None where there is none, or where its rim is not seen."""
    from scipy.ndimage import binary_closing, binary_fill_holes

    z, v = volume.centers(2), volume.voxel_m
    up = frame.points[frame.normals[:, 2] > _UP, 2]
    height = float(np.percentile(frame.points[:, 2], 99))
    up = up[up > _LEAST_HEIGHT * height]
    if len(up) < 100:
        return None
    counts, edges = np.histogram(up, bins=np.arange(up.min(), up.max() + 2 * v, v))
    top = float(np.median(up[np.abs(up - edges[np.argmax(counts)] - 0.5 * v) < 1.5 * v]))
    inside = volume.known & (volume.distance < 0)
    layer = int(np.searchsorted(z, top)) - 1
    if not 0 < layer < len(z) - 1:
        return None
    layers = inside[:, :, layer] | inside[:, :, layer - 1]
    plan = binary_closing(np.pad(layers, 2), np.ones((3, 3)), 2)[2:-2, 2:-2]
    plan = np.asarray(binary_fill_holes(plan))
    box = np.ptp(np.percentile(frame.points[:, :2], [1, 99], axis=0), axis=0).prod()
    if plan.sum() * v * v < _LEAST_SHARE * box:
        return None
    thickness = _rim_height(volume, frame, plan, top)
    return None if thickness is None else Board(plan, top, thickness)


def _rim_height(volume: ObjectVolume, frame: ObjectFrame, plan: np.ndarray, top: float) -> float | None:
    """Return the thickness in metres at which the points on the rim of a plan (nx, ny) thin out; None: nowhere."""
    from scipy.ndimage import distance_transform_edt

    inner, outer = (np.asarray(distance_transform_edt(mask)) for mask in (plan, ~plan))
    to_rim = np.minimum(inner, outer) * volume.voxel_m
    cell = np.floor((frame.points[:, :2] - volume.origin[:2]) / volume.voxel_m).astype(int)
    cell = np.clip(cell, 0, np.array(plan.shape) - 1)
    depth = top - frame.points[to_rim[tuple(cell.T)] < _RIM_M, 2]
    bins = np.arange(_BIN_M, _MOST_M + _BIN_M, _BIN_M)
    counts = np.histogram(depth, bins)[0].astype(float)
    usual = counts[_USUAL_BIN]
    few = np.flatnonzero(counts < _FEW * usual)
    if usual < _LEAST_POINTS or not len(few):
        return None
    k = int(few[0])
    before = counts[k - 1] if k else usual
    share = (before - _FEW * usual) / max(before - counts[k], 1e-9)
    return float(bins[k] + (min(max(share, 0.0), 1.0) - 0.5) * _BIN_M)


def with_underside(volume: ObjectVolume, solid: np.ndarray, board: Board) -> tuple[ObjectVolume, np.ndarray]:
    """Decide the unknown voxels at and below a board: solid down to its underside, free below that.

    Args:
        volume: the evidence.
        solid: bool (nx, ny, nz) unknown voxels that completion made solid.
        board: the result of `find_board`.

    Returns:
        The volume with these voxels known, and `solid` without them.
    """
    from scipy.ndimage import binary_dilation

    z = volume.centers(2)
    under = board.top_m - max(board.thickness_m, 2.0 * volume.voxel_m)
    lowest = under - _BELOW_M
    full = solid | (volume.known & (volume.distance < 0))
    deeper = (z < lowest) & (z > lowest - max(_BELOW_M, 3.0 * volume.voxel_m))
    goes_on = full[:, :, deeper].mean(axis=2) > 0.5 if deeper.any() else np.zeros(board.plan.shape, bool)
    open_below = board.plan & ~np.asarray(binary_dilation(goes_on, np.ones((3, 3))), bool)
    layers = (z < board.top_m) & (z > lowest)
    decided = ~volume.known & layers
    decided &= np.where(z > under, board.plan[:, :, None], open_below[:, :, None])
    wanted = np.clip(under - z, -volume.trunc_m, volume.trunc_m).astype(np.float32)
    distance = np.where(decided, wanted, volume.distance).astype(np.float32)
    near = decided & (np.abs(under - z) < volume.trunc_m)
    out = replace(volume, distance=distance, known=volume.known | decided, seen=volume.seen | near)
    return out, solid & ~decided
