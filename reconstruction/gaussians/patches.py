"""Patches of 4x4 pixels, in which the splats of a tile are blended: a patch is one vector of the processor.

A splat covers some 5 to 15 pixels a side. Of a patch more pixels lie in it than of a row of the tile, and patches that
it does not reach, or whose pixels are finished, are left out.
"""

import numba
import numpy as np

from reconstruction.gaussians.kernels import TILE

PATCH = 4  # pixels a side
PATCHES = TILE // PATCH  # a side of a tile
LANES = PATCH * PATCH
CHECK_EVERY = 16  # splats, after which finished patches are looked for
_ONE = np.float32(1.0)
_HALF = np.float32(0.5 * (PATCH - 1))  # from a patch's first pixel to its center
_ROUND = np.float32(0.5**0.5)  # radius of the screen-space filter over the square root of `reach2`
_SAFE = np.float32(1.0001)  # rounding must not lose pixels


@numba.njit(cache=True, inline="always")
def tile_bounds(tile, tiles_x, image):  # pragma: no cover - compiled
    """Return the bounds x0, y0, x1, y1 of a tile in the image."""
    x0, y0 = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
    return x0, y0, min(x0 + TILE, image.shape[1]), min(y0 + TILE, image.shape[0])


@numba.njit(cache=True, inline="always")
def lane_offsets(dtype):  # pragma: no cover - compiled
    """Return columns and rows (16,) of a patch's pixels."""
    xs, ys = np.empty(LANES, dtype), np.empty(LANES, dtype)
    for j in range(LANES):
        xs[j], ys[j] = j % PATCH, j // PATCH
    return xs, ys


@numba.njit(cache=True, inline="always")
def place_in_tile(x, y):  # pragma: no cover - compiled
    """Return the patch, and the lane in it, of pixel (x, y) of a tile."""
    return (y // PATCH) * PATCHES + x // PATCH, (y % PATCH) * PATCH + x % PATCH


@numba.njit(cache=True, inline="always")
def patches_of(box, tx, ty, x_end, y_end):  # pragma: no cover - compiled
    """Return first and end of the columns and of the rows of patches that a pixel box meets in a tile."""
    low_x, high_x = max(box[0], tx) - tx, min(box[2], x_end) - tx
    low_y, high_y = max(box[1], ty) - ty, min(box[3], y_end) - ty
    return low_x // PATCH, (high_x + PATCH - 1) // PATCH, low_y // PATCH, (high_y + PATCH - 1) // PATCH


@numba.njit(cache=True, inline="always")
def may_reach(left, top, ax, ay, bx, by, wx, wy, reach2):  # pragma: no cover - compiled
    """Return whether a patch may hold pixels with rho <= reach2; its first pixel is (left, top) from the center.

    Pixels in front of the disk's horizon need |u W| and |v W| <= sqrt(reach2) W; all others the screen-space filter.
    """
    reach = np.sqrt(reach2)
    x, y = left + _HALF, top + _HALF
    w = _ONE + wx * x + wy * y + _HALF * (abs(wx) + abs(wy))
    limit = _SAFE * reach * max(w, w - w)
    on_disk = (abs(ax * x + ay * y) - _HALF * (abs(ax) + abs(ay)) <= limit) & (
        abs(bx * x + by * y) - _HALF * (abs(bx) + abs(by)) <= limit
    )
    around = _HALF + _SAFE * _ROUND * reach
    return on_disk | ((abs(x) <= around) & (abs(y) <= around))


@numba.njit(cache=True)
def mark_finished(light, stop, finished):  # pragma: no cover - compiled
    """Mark in `finished` (16,) the patches whose transmittance (16, 16) is below `stop`; return whether all are."""
    every = True
    for i in range(len(finished)):
        finished[i] = finished[i] or light[i].max() < stop
        every = every and finished[i]
    return every
