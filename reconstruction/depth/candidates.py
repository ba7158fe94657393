"""Candidate depths of each pixel: its own, and planes of nearby surfaces extended to it."""

import numba
import numpy as np

from reconstruction.depth.windows import FAST

_RINGS_PX = (2, 4, 7, 11, 18)
OFFSETS = np.array(
    [(0, 0)]
    + [
        (round(r * dy / np.hypot(dy, dx)), round(r * dx / np.hypot(dy, dx)))
        for r in _RINGS_PX
        for dy in (-1, 0, 1)
        for dx in (-1, 0, 1)
        if (dy, dx) != (0, 0)
    ],
    np.int64,
)
"""(k, 2) rows and columns from a pixel to the pixels whose surfaces it may lie on; the first is itself."""
SPREAD = np.float32(0.02)
"""Relative difference of depths at which a candidate has half a say in another one's probability."""
_KEPT = np.float32(0.9)  # a pixel keeps its own depth from this share of the mode's probability on
_NO_MODE = np.float32(0.01)  # candidates less probable than this are no mode
JUMP = np.float32(0.012)
"""Relative change of inverse depth from pixel to pixel up to which a surface goes on."""
SLOPE_REACH, SLOPE_STRIDE = 6, 2
"""Pixels whose slopes are averaged: far candidates amplify a slope's noise."""
MOST_BENT = np.float32(0.3)
"""Relative change of inverse depth up to which a plane is extended."""


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=FAST, forceinline=True)
def _add_slopes(rho, gx, gy, here, own_x, own_y, dx, dy, sx, sy, n):  # pragma: no cover - compiled
    """Add to the sums of a row of pixels the slopes of their neighbors (dx, dy) away that lie on their planes."""
    one, nil, dx, dy = np.float32(1.0), np.float32(0.0), np.float32(dx), np.float32(dy)
    for x in range(len(here)):
        off = abs(rho[x] - here[x] - own_x[x] * dx - own_y[x] * dy)
        m = one if (rho[x] > nil) & (off < JUMP * here[x]) else nil
        sx[x] += m * gx[x]
        sy[x] += m * gy[x]
        n[x] += m


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _mean_slopes(rho, gx, gy, out_x, out_y):  # pragma: no cover - compiled
    """Average slopes over the neighbors that lie on a pixel's plane; 0 where there is no depth."""
    h, w = rho.shape
    n = np.empty(w, np.float32)
    for y in range(h):
        sx, sy = out_x[y], out_y[y]
        sx[:], sy[:], n[:] = 0.0, 0.0, 0.0
        for j in range(y - SLOPE_REACH, y + SLOPE_REACH + 1, SLOPE_STRIDE):
            for dx in range(-SLOPE_REACH, SLOPE_REACH + 1, SLOPE_STRIDE):
                low, high = max(0, -dx), w - max(0, dx)
                if 0 <= j < h and low < high:
                    there, here = slice(low + dx, high + dx), slice(low, high)
                    _add_slopes(
                        rho[j, there], gx[j, there], gy[j, there], rho[y, here], gx[y, here], gy[y, here], dx, j - y,
                        sx[here], sy[here], n[here],
                    )  # fmt: skip
        for x in range(w):
            if rho[y, x] > 0.0:
                sx[x] = sx[x] / n[x] if n[x] > 0 else gx[y, x]
                sy[x] = sy[x] / n[x] if n[x] > 0 else gy[y, x]


@numba.njit(cache=True, nogil=True)
def _extend(rho, gx, gy, offsets, out):  # pragma: no cover - compiled
    h, w = rho.shape
    out[:] = 0.0
    for k in range(len(offsets)):
        dy, dx = offsets[k]
        across, down = np.float32(dx), np.float32(dy)
        low, high = max(0, -dx), max(0, -dx, w - max(0, dx))
        for y in range(max(0, -dy), h - max(0, dy)):
            there = slice(low + dx, high + dx)
            r, x_slope, y_slope, at = (
                rho[y + dy, there],
                gx[y + dy, there],
                gy[y + dy, there],
                out[k, y, low:high],
            )
            for x in range(len(r)):
                q = r[x] - x_slope[x] * across - y_slope[x] * down
                at[x] = q if abs(q - r[x]) < MOST_BENT * r[x] else np.float32(0.0)


def candidate_depths(rho: np.ndarray) -> np.ndarray:
    """Return the inverse depths float32 (k, h, w) that the surfaces at OFFSETS would have at each pixel; 0 = none.

    Inverse depth of a plane is linear in the picture.

    Args:
        rho: float32 (h, w) inverse depth, 0 = unknown.
    """
    from reconstruction.depth.refine import fit_slopes

    fitted, gx, gy, sx, sy = (np.zeros(rho.shape, np.float32) for _ in range(5))
    fit_slopes(rho, float(JUMP), fitted, gx, gy)
    _mean_slopes(rho, gx, gy, sx, sy)
    out = np.empty((len(OFFSETS), *rho.shape), np.float32)
    _extend(rho, sx, sy, OFFSETS, out)
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=FAST, forceinline=True)
def _support(candidates, share, at):  # pragma: no cover - compiled
    """Return the probability of a depth's neighborhood: all candidates, weighed by how near they are."""
    total, one, inverse = np.float32(0.0), np.float32(1.0), np.float32(1.0) / (SPREAD * at)
    for j in range(len(candidates)):
        off = (candidates[j] - at) * inverse
        total += share[j] / (one + off * off)
    return total


@numba.njit(cache=True, nogil=True, error_model="numpy")
def choose_candidates(candidates, share, least, out, trust):  # pragma: no cover - compiled
    """Write the mode of a pixel's candidates as a mixture, and the probability around it.

    A pixel's own depth is kept where it is nearly the mode.

    Args:
        candidates: (k, h, w) inverse depths, 0 = none; the first is the pixel's own.
        share: (k, h, w) probability that each is right.
        least: Probability from which depth is believed; less: unknown.
        out: float32 (h, w) inverse depth, written.
        trust: float32 (h, w) probability, written.
    """
    k, h, w = candidates.shape
    depths, shares = np.empty(k, np.float32), np.empty(k, np.float32)
    for y in range(h):
        for x in range(w):
            whole = np.float32(0.0)
            for i in range(k):
                depths[i] = candidates[i, y, x]
                shares[i] = share[i, y, x] if depths[i] > 0.0 else np.float32(0.0)
                whole += shares[i]
            value = depths[0]
            own = _support(depths, shares, value) if value > 0.0 else np.float32(0.0)
            best = own
            # No mode has more than the whole: most pixels are done here.
            others = k if own < _KEPT * whole else 1
            for i in range(1, others):
                if shares[i] < _NO_MODE:
                    continue
                total = _support(depths, shares, depths[i])
                if total > best:
                    best, value = total, depths[i]
            if own >= _KEPT * best and own > 0.0:
                best, value = own, depths[0]
            trust[y, x] = best
            out[y, x] = value if best >= least else np.float32(0.0)
