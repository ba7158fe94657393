"""The underside of a board on legs: no camera sees it, but the board's rim says how thick the board is.

From above, depth reaches a few centimetres into a table top, and what lies below is unknown: between aprons and legs
it passes for enclosed, without them the top ends as a sheet. All around the top its rim was seen, and what is free
below the rim.
"""

from dataclasses import dataclass, replace

import numpy as np

from reconstruction.assets.volume import ObjectFrame, ObjectVolume

_UP = 0.85  # cosine
_LEAST_SHARE = 0.25  # of the box's plan that the board covers
_LEAST_HEIGHT = 0.85  # of the thing's height: boards above that are tops
_RIM_M = 0.02
_MOST_M = 0.12  # thickness of a board
_BIN_M, _USUAL_BIN = 0.005, 1  # depth below a board's upper edge, which itself is round
_FEW, _LEAST_POINTS = 0.2, 30  # share of the usual points: a rim's lower part is seen less
_BELOW_M = 0.06  # the space so far below the board is empty; what goes on below that is a leg or a box


@dataclass(frozen=True)
class Board:
    """A level board that ends in free space all around."""

    plan: np.ndarray  # bool (nx, ny) columns
    top_m: float  # grid frame
    thickness_m: float


def find_board(volume: ObjectVolume, frame: ObjectFrame) -> Board | None:
    """Return the highest large board of a thing and how thick its rim is; None where there is none, or no rim."""
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
    plan = binary_closing(np.pad(inside[:, :, layer] | inside[:, :, layer - 1], 2), np.ones((3, 3)), 2)[
        2:-2, 2:-2
    ]
    plan = binary_fill_holes(plan)
    box = np.ptp(np.percentile(frame.points[:, :2], [1, 99], axis=0), axis=0).prod()
    if plan.sum() * v * v < _LEAST_SHARE * box:
        return None
    thickness = _rim_height(volume, frame, plan, top)
    return None if thickness is None else Board(plan, top, thickness)


def _rim_height(volume: ObjectVolume, frame: ObjectFrame, plan: np.ndarray, top: float) -> float | None:
    """Return how far below `top` the points on the rim of a plan (nx, ny) become few; None where they do not."""
    from scipy.ndimage import distance_transform_edt

    to_rim = np.minimum(distance_transform_edt(plan), distance_transform_edt(~plan)) * volume.voxel_m
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
    """Return the volume with the unknown below a board's top decided, and what else of the unknown is solid.

    Args:
        volume: the evidence.
        solid: bool (nx, ny, nz) unknown voxels that passed for solid.
        board: of `find_board`.
    """
    from scipy.ndimage import binary_dilation

    z = volume.centers(2)
    under = board.top_m - max(board.thickness_m, 2.0 * volume.voxel_m)
    lowest = under - _BELOW_M
    full = solid | (volume.known & (volume.distance < 0))
    deeper = (z < lowest) & (z > lowest - max(_BELOW_M, 3.0 * volume.voxel_m))
    goes_on = full[:, :, deeper].mean(axis=2) > 0.5 if deeper.any() else np.zeros(board.plan.shape, bool)
    open_below = board.plan & ~binary_dilation(goes_on, np.ones((3, 3)))
    layers = (z < board.top_m) & (z > lowest)
    decided = ~volume.known & layers
    decided &= np.where(z > under, board.plan[:, :, None], open_below[:, :, None])
    wanted = np.clip(under - z, -volume.trunc_m, volume.trunc_m).astype(np.float32)
    distance = np.where(decided, wanted, volume.distance).astype(np.float32)
    near = decided & (np.abs(under - z) < volume.trunc_m)
    out = replace(volume, distance=distance, known=volume.known | decided, seen=volume.seen | near)
    return out, solid & ~decided
