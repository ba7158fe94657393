"""Compiled plane sweep: zero-mean normalized cross-correlation (ZNCC) of windows, for every inverse depth.

Sources are warped row by row by the homography of a fronto-parallel plane (Collins, CVPR 1996). Sums over windows are
running sums, so that the cost does not grow with the window's height.
"""

import math

import numba
import numpy as np

from reconstruction.depth.vector_memory import load_only_read, store_apart
from reconstruction.depth.windows import FAST

_RADIUS = 2  # 5x5 windows
REACH_PX = _RADIUS  # so far from its pixel a window reaches
_ROWS = 2 * _RADIUS + 1


@numba.njit(cache=True, nogil=True)
def _window_moments(reference, mean, inverse_deviation, zero):  # pragma: no cover - compiled
    """Mean and inverse noise-floored deviation of every window of the reference, windows clipped at the border."""
    h, w = reference.shape
    for y in range(h):
        for x in range(w):
            s, q, n = 0.0, 0.0, 0
            for j in range(max(0, y - _RADIUS), min(h, y + _RADIUS + 1)):
                for i in range(max(0, x - _RADIUS), min(w, x + _RADIUS + 1)):
                    s += reference[j, i]
                    q += reference[j, i] * reference[j, i]
                    n += 1
            mean[y, x] = s / n
            inverse_deviation[y, x] = 1.0 / math.sqrt(max(q / n - (s / n) ** 2, 0.0) + zero)


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=FAST, forceinline=True)
def _warp_row(source, height, width, h_inf, shift, rho, y, out, inside):  # pragma: no cover - compiled
    """Resample a source for row y of the reference at inverse depth rho (bilinear, border repeated).

    `source` is float32 (height * width,); `out` (w,) and `inside` (w,), 1 or 0, are written.
    """
    py = y + 0.5
    a0, a1, a2 = np.float32(h_inf[0, 0]), np.float32(h_inf[1, 0]), np.float32(h_inf[2, 0])
    b0 = np.float32(h_inf[0, 1] * py + h_inf[0, 2] + rho * shift[0])
    b1 = np.float32(h_inf[1, 1] * py + h_inf[1, 2] + rho * shift[1])
    b2 = np.float32(h_inf[2, 1] * py + h_inf[2, 2] + rho * shift[2])
    top_u, top_v = np.float32(width - 1.001), np.float32(height - 1.001)
    end_u, end_v = np.float32(width - 0.5), np.float32(height - 0.5)
    half, nil, one, least = np.float32(0.5), np.float32(0.0), np.float32(1.0), np.float32(1e-9)
    stride, right, below = np.int32(width), np.uint32(1), np.uint32(width)
    for x in range(len(out)):
        px = np.float32(np.int32(x)) + half
        z = a2 * px + b2
        inv = one / max(z, least)
        u = (a0 * px + b0) * inv - half
        v = (a1 * px + b1) * inv - half
        seen = (z > least) & (u > -half) & (v > -half) & (u < end_u) & (v < end_v)
        u = min(max(u, nil), top_u)
        v = min(max(v, nil), top_v)
        ix, iy = np.int32(u), np.int32(v)
        fx, fy = u - np.float32(ix), v - np.float32(iy)
        p = np.uint32(iy * stride + ix)
        a, b = load_only_read(source, p), load_only_read(source, p + right)  # pyright: ignore[reportCallIssue]
        c, d = load_only_read(source, p + below), load_only_read(source, p + below + right)  # pyright: ignore[reportCallIssue]
        top = a + fx * (b - a)
        low = c + fx * (d - c)
        store_apart(out, x, top + fy * (low - top))
        store_apart(inside, x, one if seen else nil)


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=FAST, forceinline=True)
def _move_down(new, old, reference_new, reference_old, s, q, p):  # pragma: no cover - compiled
    """Take a row into the column sums of gray, its square and its product with the reference, and one row out."""
    for x in range(len(new)):
        a, c = new[x], old[x]
        s[x] += a - c
        q[x] += a * a - c * c
        p[x] += a * reference_new[x] - c * reference_old[x]


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=FAST, forceinline=True)
def _score_row(
    s, q, p, share, row_share, mean, inverse_deviation, zero, inside, first, second
):  # pragma: no cover - compiled
    """Correlation of a row of windows from column sums (w + 4,); `first` and `second` (w,) keep the two best so far."""
    nil, none = np.float32(0.0), np.float32(-2.0)
    for x in range(len(first)):
        f = share[x] * row_share
        a = (s[x] + s[x + 1] + s[x + 2] + s[x + 3] + s[x + 4]) * f
        b = (q[x] + q[x + 1] + q[x + 2] + q[x + 3] + q[x + 4]) * f
        c = (p[x] + p[x + 1] + p[x + 2] + p[x + 3] + p[x + 4]) * f
        score = (c - a * mean[x]) * inverse_deviation[x] / np.sqrt(max(b - a * a, nil) + zero)
        score = score if inside[x] > nil else none
        second[x] = max(second[x], min(first[x], score))
        first[x] = max(first[x], score)


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=FAST, forceinline=True)
def _write_row(first, second, out):  # pragma: no cover - compiled
    """Write the cost of a row of pixels from its two best correlations."""
    nil, one, half = np.float32(0.0), np.float32(1.0), np.float32(0.5)
    for x in range(len(first)):
        a, b = first[x], second[x]
        # One source alone may match by chance: it counts half.
        one_or_none = half * a if a > np.float32(-1.5) else nil
        score = half * (a + b) if b > np.float32(-1.5) else one_or_none
        out[x] = np.uint8(np.int32(min(np.float32(254.0), max(nil, np.float32(127.0) * (one - score)))))


@numba.njit(cache=True, nogil=True)
def sweep_costs(reference, sources, h_inf, shift, rhos, noise, out):  # pragma: no cover - compiled
    """Write 127 * (1 - correlation) to out[plane, y, x], the mean of the two best sources (others may be occluded).

    `reference` (h, w) and `sources` (s, h, w) are float32 gray minus 128, so that single precision is enough for the
    running sums; source pixel ~ h_inf @ p + rho * shift.
    """
    h, w = reference.shape
    s, sh, sw = sources.shape
    r = _RADIUS
    flat = sources.reshape(s, sh * sw)
    zero = np.float32(noise * noise)
    mean, inverse_deviation = np.empty((h, w), np.float32), np.empty((h, w), np.float32)
    _window_moments(reference, mean, inverse_deviation, zero)
    share = np.empty(w, np.float32)
    for x in range(w):
        share[x] = 1.0 / (min(w - 1, x + r) - max(0, x - r) + 1)
    columns = np.zeros((3, w + 2 * r), np.float32)  # two empty columns on either side
    cs, cq, cp = columns[0], columns[1], columns[2]
    ring, inside = np.empty((_ROWS, w), np.float32), np.empty((_ROWS, w), np.float32)
    new, blank = np.empty(w, np.float32), np.zeros(w, np.float32)
    first, second = np.empty((h, w), np.float32), np.empty((h, w), np.float32)
    for d in range(len(rhos)):
        first[:] = -2.0
        second[:] = -2.0
        for k in range(s):
            columns[:] = 0.0
            ring[:] = 0.0
            for y in range(-r, h):
                add, drop, slot = y + r, y - r - 1, (y + r) % _ROWS
                taken = blank
                if add < h:
                    _warp_row(flat[k], sh, sw, h_inf[k], shift[k], rhos[d], add, new, inside[slot])
                    taken = reference[add]
                else:
                    new[:] = 0.0
                left = reference[drop] if drop >= 0 else blank
                _move_down(new, ring[slot], taken, left, cs[r : r + w], cq[r : r + w], cp[r : r + w])
                ring[slot] = new
                if y < 0:
                    continue
                row_share = np.float32(1.0 / (min(h - 1, y + r) - max(0, y - r) + 1))
                _score_row(
                    cs, cq, cp, share, row_share, mean[y], inverse_deviation[y], zero,
                    inside[y % _ROWS], first[y], second[y],
                )  # fmt: skip
        for y in range(h):
            _write_row(first[y], second[y], out[d, y])
