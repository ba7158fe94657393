"""Plane sweep: zero-mean normalised correlation of every pixel's window with the sources, for every inverse depth."""

import math

import numba
import numpy as np

_RADIUS = 2  # 5x5 windows


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


@numba.njit(cache=True, nogil=True)
def _correlate(
    warped, inside, reference, mean_r, inverse_deviation, zero, first, second
):  # pragma: no cover - compiled
    """Correlation of 5x5 windows by running column sums; the cost does not grow with the window's height.

    The two best correlations of each pixel so far are kept in `first` and `second`.
    Gray levels are centred on zero, so that single precision is enough for the running sums.
    """
    h, w = reference.shape
    r = _RADIUS
    columns = np.zeros((3, w + 2 * r), np.float32)
    share = np.empty(w, np.float32)
    for x in range(w):
        share[x] = 1.0 / (min(w - 1, x + r) - max(0, x - r) + 1)
    for y in range(-r, h):
        add, drop = y + r, y - r - 1
        if add < h:
            for x in range(w):
                a, b = warped[add, x], reference[add, x]
                columns[0, x + r] += a
                columns[1, x + r] += a * a
                columns[2, x + r] += a * b
        if drop >= 0:
            for x in range(w):
                a, b = warped[drop, x], reference[drop, x]
                columns[0, x + r] -= a
                columns[1, x + r] -= a * a
                columns[2, x + r] -= a * b
        if y < 0:
            continue
        rows = min(h - 1, y + r) - max(0, y - r) + 1
        row_share = np.float32(1.0 / rows)
        for x in range(w):
            scale = row_share * share[x]
            s = np.float32(0.0)
            q = np.float32(0.0)
            p = np.float32(0.0)
            for i in range(2 * r + 1):
                s += columns[0, x + i]
                q += columns[1, x + i]
                p += columns[2, x + i]
            s, q, p = s * scale, q * scale, p * scale
            variance = max(q - s * s, np.float32(0.0)) + zero
            score = (p - s * mean_r[y, x]) / np.sqrt(variance) * inverse_deviation[y, x]
            score = score if inside[y, x] else np.float32(-2.0)
            second[y, x] = max(second[y, x], min(first[y, x], score))
            first[y, x] = max(first[y, x], score)


@numba.njit(cache=True, nogil=True)
def _warp(source, h_inf, shift, rho, out, inside):  # pragma: no cover - compiled
    """Resample a source as the reference would see it if all lay at inverse depth rho (bilinear, border repeated)."""
    h, w = out.shape
    sh, sw = source.shape
    a0, a1, a2 = np.float32(h_inf[0, 0]), np.float32(h_inf[1, 0]), np.float32(h_inf[2, 0])
    top_u, top_v = np.float32(sw - 1.001), np.float32(sh - 1.001)
    half, nil, one = np.float32(0.5), np.float32(0.0), np.float32(1.0)
    for y in range(h):
        py = y + 0.5
        b0 = np.float32(h_inf[0, 1] * py + h_inf[0, 2] + rho * shift[0])
        b1 = np.float32(h_inf[1, 1] * py + h_inf[1, 2] + rho * shift[1])
        b2 = np.float32(h_inf[2, 1] * py + h_inf[2, 2] + rho * shift[2])
        for x in range(w):
            px = np.float32(x) + half
            z = a2 * px + b2
            if z <= np.float32(1e-9):
                out[y, x] = nil
                inside[y, x] = False
                continue
            inv = one / z
            u = (a0 * px + b0) * inv - half
            v = (a1 * px + b1) * inv - half
            inside[y, x] = u > -half and v > -half and u < sw - half and v < sh - half
            u = min(max(u, nil), top_u)
            v = min(max(v, nil), top_v)
            ix, iy = int(u), int(v)
            fx, fy = u - np.float32(ix), v - np.float32(iy)
            top = source[iy, ix] + fx * (source[iy, ix + 1] - source[iy, ix])
            low = source[iy + 1, ix] + fx * (source[iy + 1, ix + 1] - source[iy + 1, ix])
            out[y, x] = top + fy * (low - top)


@numba.njit(cache=True, nogil=True)
def sweep_costs(reference, sources, h_inf, shift, rhos, noise, out):  # pragma: no cover - compiled
    """Fill out[plane, y, x] with 127 * (1 - correlation), mean of the two best sources.

    Occlusion spoils the others.

    `reference` (h, w) and `sources` (s, h, w) are float32 gray minus 128; source pixel ~ h_inf @ p + rho * shift.
    """
    h, w = reference.shape
    s = sources.shape[0]
    zero = np.float32(noise * noise)
    mean_r, inverse_deviation = np.empty((h, w), np.float32), np.empty((h, w), np.float32)
    _window_moments(reference, mean_r, inverse_deviation, zero)
    warped = np.empty((h, w), np.float32)
    inside = np.empty((h, w), np.bool_)
    first, second = np.empty((h, w), np.float32), np.empty((h, w), np.float32)
    for d in range(len(rhos)):
        first[:] = -2.0
        second[:] = -2.0
        for k in range(s):
            _warp(sources[k], h_inf[k], shift[k], rhos[d], warped, inside)
            _correlate(warped, inside, reference, mean_r, inverse_deviation, zero, first, second)
        for y in range(h):
            for x in range(w):
                a, b = first[y, x], second[y, x]
                # One source alone may match by chance: it counts half.
                score = 0.5 * (a + b) if b > -1.5 else (0.5 * a if a > -1.5 else 0.0)
                out[d, y, x] = np.uint8(min(254.0, max(0.0, 127.0 * (1.0 - score))))
