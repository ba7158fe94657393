"""Compiled kernel that moves depth edges to image edges by a vote of pixels of the same color."""

import numba
import numpy as np

from reconstruction.depth.votes import SAME, make_votes, voters

_REACH = 9
_MAX_CANDIDATES = 5
_DOUBTED_SAY = 0.25
_votes = make_votes(_REACH, stride=3, tone=9.0, most_tone=30.0, px=50.0**0.5)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _near_jump(rho, y, x, jump):  # pragma: no cover - compiled
    h, w = rho.shape
    r = rho[y, x]
    for dy in (-6, 0, 6):
        for dx in (-6, 0, 6):
            j, i = min(max(y + dy, 0), h - 1), min(max(x + dx, 0), w - 1)
            if abs(rho[j, i] - r) > jump * r:
                return True
    return False


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _mark_doubt(rho, doubt):  # pragma: no cover - compiled
    """Mark in doubt (h, w) the pixels beside a jump."""
    for y in range(rho.shape[0]):
        for x in range(rho.shape[1]):
            doubt[y, x] = rho[y, x] > 0.0 and _near_jump(rho, y, x, 0.025)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _candidates(rho, gx, gy, y, x, out):  # pragma: no cover - compiled
    """Write the surfaces around a pixel, extended to it, to out (m, 3): its own first; return how many."""
    h, w = rho.shape
    out[0, 0], out[0, 1], out[0, 2] = rho[y, x], gx[y, x], gy[y, x]
    count = 1
    for reach in ((_REACH + 2) // 2, _REACH + 2):
        for dy in (-reach, 0, reach):
            for dx in (-reach, 0, reach):
                j, i = y + dy, x + dx
                if j < 0 or i < 0 or j >= h or i >= w or count == _MAX_CANDIDATES:
                    continue
                q = rho[j, i] - gx[j, i] * np.float32(dx) - gy[j, i] * np.float32(dy)
                fresh = q > 0.0
                for c in range(count):
                    if abs(q - out[c, 0]) < np.float32(SAME) * out[c, 0]:
                        fresh = False
                if fresh:
                    out[count, 0], out[count, 1], out[count, 2] = q, gx[j, i], gy[j, i]
                    count += 1
    return count


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _choose(rho, gx, gy, doubt, maps, width, out):  # pragma: no cover - compiled
    """Write to out (h, w) the inverse depth that most voters of `maps` around a pixel in doubt lie on."""
    candidates = np.empty((_MAX_CANDIDATES, 3), np.float32)
    votes = np.empty(_MAX_CANDIDATES, np.float32)
    for y in range(rho.shape[0]):
        for x in range(rho.shape[1]):
            out[y, x] = rho[y, x]
            if not doubt[y, x]:
                continue
            count = _candidates(rho, gx, gy, y, x, candidates)
            if count == 1:
                continue
            _votes(maps, width, y, x, candidates, count, votes)
            best = 0
            for c in range(1, count):
                if votes[c] > np.float32(1.1) * votes[0] and votes[c] > votes[best]:
                    best = c
            out[y, x] = candidates[best, 0]


def sharpen_edges(
    rho: np.ndarray, gx: np.ndarray, gy: np.ndarray, score: np.ndarray, color: np.ndarray, out: np.ndarray
) -> None:
    """Reassign pixels beside depth jumps to the surface that most nearby pixels of their color lie on.

    Args:
        rho: (h, w) inverse depth.
        gx: (h, w) its slope along x.
        gy: (h, w) its slope along y.
        score: (h, w) correlation, the weight of a vote.
        color: float32 (h, w, 3).
        out: (h, w), written.
    """
    doubt = np.empty(rho.shape, bool)
    _mark_doubt(rho, doubt)
    maps = voters(rho, score, doubt, _DOUBTED_SAY, color, _REACH)
    _choose(rho, gx, gy, doubt, maps.reshape(len(maps), -1), maps.shape[2], out)
