"""Candidate depths of each pixel: its own, and planes of nearby surfaces extended to it."""

import numba
import numpy as np

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


@numba.njit(cache=True, nogil=True)
def _mean_slopes(rho, gx, gy, out_x, out_y):  # pragma: no cover - compiled
    """Average slopes over the neighbors that lie on a pixel's plane."""
    h, w = rho.shape
    for y in range(h):
        for x in range(w):
            r = rho[y, x]
            if r <= 0.0:
                out_x[y, x] = 0.0
                out_y[y, x] = 0.0
                continue
            sx, sy, n = np.float32(0.0), np.float32(0.0), np.float32(0.0)
            for dy in range(-SLOPE_REACH, SLOPE_REACH + 1, SLOPE_STRIDE):
                j = y + dy
                if j < 0 or j >= h:
                    continue
                for dx in range(-SLOPE_REACH, SLOPE_REACH + 1, SLOPE_STRIDE):
                    i = x + dx
                    if i < 0 or i >= w or rho[j, i] <= 0.0:
                        continue
                    if abs(rho[j, i] - r - gx[y, x] * dx - gy[y, x] * dy) < JUMP * r:
                        sx += gx[j, i]
                        sy += gy[j, i]
                        n += np.float32(1.0)
            out_x[y, x] = sx / n if n > 0 else gx[y, x]
            out_y[y, x] = sy / n if n > 0 else gy[y, x]


@numba.njit(cache=True, nogil=True)
def _extend(rho, gx, gy, offsets, out):  # pragma: no cover - compiled
    h, w = rho.shape
    for k in range(len(offsets)):
        dy, dx = offsets[k]
        for y in range(h):
            j = y + dy
            for x in range(w):
                i = x + dx
                out[k, y, x] = 0.0
                if j < 0 or j >= h or i < 0 or i >= w:
                    continue
                r = rho[j, i]
                if r <= 0.0:
                    continue
                there = r - gx[j, i] * dx - gy[j, i] * dy
                if abs(there - r) < MOST_BENT * r:
                    out[k, y, x] = there


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


@numba.njit(cache=True, nogil=True)
def _support(candidates, share, at, y, x, spread):  # pragma: no cover - compiled
    """Return the probability of a depth's neighborhood: all candidates, weighed by how near they are."""
    total = np.float32(0.0)
    for j in range(len(candidates)):
        c = candidates[j, y, x]
        if c > 0.0:
            off = (c - at) / (spread * at)
            total += share[j, y, x] / (np.float32(1.0) + off * off)
    return total


@numba.njit(cache=True, nogil=True)
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
    for y in range(h):
        for x in range(w):
            value = candidates[0, y, x]
            own = _support(candidates, share, value, y, x, SPREAD) if value > 0.0 else np.float32(0.0)
            best, whole = own, np.float32(0.0)
            for i in range(k):
                whole += share[i, y, x]
            # No mode has more than the whole: most pixels are done here.
            others = k if own < _KEPT * whole else 1
            for i in range(1, others):
                at = candidates[i, y, x]
                if at <= 0.0 or share[i, y, x] < _NO_MODE:
                    continue
                total = _support(candidates, share, at, y, x, SPREAD)
                if total > best:
                    best, value = total, at
            if own >= _KEPT * best and own > 0.0:
                best, value = own, candidates[0, y, x]
            trust[y, x] = best
            out[y, x] = value if best >= least else np.float32(0.0)
