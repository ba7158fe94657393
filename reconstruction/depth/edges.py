"""Compiled kernel that moves depth edges to image edges by a vote of pixels of the same color."""

import numba
import numpy as np

_REACH = 9
_STRIDE = 3
_MAX_CANDIDATES = 5
# Weights by difference of color (whole levels) and by place.
_LEVELS = np.arange(256)
_BY_TONE = np.where(_LEVELS > 30, 0, np.exp(-0.5 * (_LEVELS / 9.0) ** 2)).astype(np.float32)
_BY_STEP = np.exp(-0.5 * np.arange(_REACH + 1) ** 2 / 50.0).astype(np.float32)


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
def sharpen_edges(rho, gx, gy, score, color, out):  # pragma: no cover - compiled
    """Reassign pixels beside depth jumps to the surface that most nearby pixels of their color lie on.

    Args:
        rho: (h, w) inverse depth.
        gx: (h, w) its slope along x.
        gy: (h, w) its slope along y.
        score: (h, w) correlation, the weight of a vote.
        color: float32 (h, w, 3).
        out: (h, w), written.
    """
    h, w = rho.shape
    far = _REACH + 2
    # Pixels beside a jump are in doubt; their votes count a quarter.
    doubt = np.empty((h, w), np.bool_)
    for y in range(h):
        for x in range(w):
            doubt[y, x] = rho[y, x] > 0.0 and _near_jump(rho, y, x, 0.025)
    candidates = np.empty((_MAX_CANDIDATES, 3))
    votes = np.empty(_MAX_CANDIDATES)
    for y in range(h):
        for x in range(w):
            r = rho[y, x]
            out[y, x] = r
            if not doubt[y, x]:
                continue
            candidates[0, 0], candidates[0, 1], candidates[0, 2] = r, gx[y, x], gy[y, x]
            count = 1
            for reach in (far // 2, far):
                for dy in (-reach, 0, reach):
                    for dx in (-reach, 0, reach):
                        j, i = y + dy, x + dx
                        if j < 0 or i < 0 or j >= h or i >= w or count == _MAX_CANDIDATES:
                            continue
                        q = rho[j, i] - gx[j, i] * dx - gy[j, i] * dy
                        fresh = q > 0.0
                        for c in range(count):
                            if abs(q - candidates[c, 0]) < 0.012 * candidates[c, 0]:
                                fresh = False
                        if fresh:
                            candidates[count, 0], candidates[count, 1] = q, gx[j, i]
                            candidates[count, 2] = gy[j, i]
                            count += 1
            if count == 1:
                continue
            votes[:] = 0.0
            for dy in range(-_REACH, _REACH + 1, _STRIDE):
                j = y + dy
                if j < 0 or j >= h:
                    continue
                for dx in range(-_REACH, _REACH + 1, _STRIDE):
                    i = x + dx
                    if i < 0 or i >= w:
                        continue
                    d = abs(color[j, i, 0] - color[y, x, 0])
                    d = max(d, abs(color[j, i, 1] - color[y, x, 1]))
                    q = _BY_TONE[int(max(d, abs(color[j, i, 2] - color[y, x, 2])))]
                    if q == 0.0:
                        continue
                    q *= _BY_STEP[abs(dx)] * _BY_STEP[abs(dy)] * max(np.float32(0.15), score[j, i])
                    if doubt[j, i]:
                        q *= np.float32(0.25)
                    for c in range(count):
                        expected = candidates[c, 0] + candidates[c, 1] * dx + candidates[c, 2] * dy
                        if abs(rho[j, i] - expected) < 0.012 * expected:
                            votes[c] += q
            best = 0
            for c in range(1, count):
                if votes[c] > 1.1 * votes[0] and votes[c] > votes[best]:
                    best = c
            out[y, x] = candidates[best, 0]
