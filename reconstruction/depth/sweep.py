"""Plane sweep: zero-mean normalised correlation of every pixel's window with the sources, for every inverse depth."""

import math

import numba
import numpy as np

_RADIUS = 2  # 5x5 windows


@numba.njit(cache=True, nogil=True)
def _box_rows(values, other, radius, mean, product):  # pragma: no cover - compiled
    """Box means of `values` and of `values * other`, windows clipped at the border."""
    h, w = values.shape
    column = np.zeros(w)
    column_p = np.zeros(w)
    for y in range(-radius, h):
        add, drop = y + radius, y - radius - 1
        if add < h:
            for x in range(w):
                column[x] += values[add, x]
                column_p[x] += values[add, x] * other[add, x]
        if drop >= 0:
            for x in range(w):
                column[x] -= values[drop, x]
                column_p[x] -= values[drop, x] * other[drop, x]
        if y < 0:
            continue
        rows = min(h - 1, y + radius) - max(0, y - radius) + 1
        s, p = 0.0, 0.0
        for x in range(-radius, w):
            if x + radius < w:
                s += column[x + radius]
                p += column_p[x + radius]
            if x - radius - 1 >= 0:
                s -= column[x - radius - 1]
                p -= column_p[x - radius - 1]
            if x >= 0:
                area = rows * (min(w - 1, x + radius) - max(0, x - radius) + 1)
                mean[y, x] = s / area
                product[y, x] = p / area


@numba.njit(cache=True, nogil=True)
def _warp(source, h_inf, shift, rho, out, inside):  # pragma: no cover - compiled
    """Resample a source as the reference would see it if all lay at inverse depth rho (bilinear, border repeated)."""
    h, w = out.shape
    sh, sw = source.shape
    a0, a1, a2 = h_inf[0, 0], h_inf[1, 0], h_inf[2, 0]
    for y in range(h):
        py = y + 0.5
        b0 = h_inf[0, 1] * py + h_inf[0, 2] + rho * shift[0]
        b1 = h_inf[1, 1] * py + h_inf[1, 2] + rho * shift[1]
        b2 = h_inf[2, 1] * py + h_inf[2, 2] + rho * shift[2]
        for x in range(w):
            px = x + 0.5
            z = a2 * px + b2
            if z <= 1e-9:
                out[y, x] = 0.0
                inside[y, x] = False
                continue
            inv = 1.0 / z
            u = (a0 * px + b0) * inv - 0.5
            v = (a1 * px + b1) * inv - 0.5
            inside[y, x] = u > -0.5 and v > -0.5 and u < sw - 0.5 and v < sh - 0.5
            u = min(max(u, 0.0), sw - 1.001)
            v = min(max(v, 0.0), sh - 1.001)
            ix, iy = int(u), int(v)
            fx, fy = np.float32(u - ix), np.float32(v - iy)
            top = source[iy, ix] + fx * (source[iy, ix + 1] - source[iy, ix])
            low = source[iy + 1, ix] + fx * (source[iy + 1, ix + 1] - source[iy + 1, ix])
            out[y, x] = top + fy * (low - top)


@numba.njit(cache=True, nogil=True)
def sweep_costs(reference, sources, h_inf, shift, rhos, noise, out):  # pragma: no cover - compiled
    """Fill out[y, x, plane] with 127 * (1 - correlation), the mean of the better half of the sources.

    `reference` (h, w) and `sources` (s, h, w) are float32 gray; source pixel ~ h_inf @ p + rho * shift.
    """
    h, w = reference.shape
    s = sources.shape[0]
    keep = max(1, (s + 1) // 2)
    zero = noise * noise
    mean_r, square_r = np.empty((h, w), np.float32), np.empty((h, w), np.float32)
    _box_rows(reference, reference, _RADIUS, mean_r, square_r)
    deviation = np.empty((h, w), np.float32)
    for y in range(h):
        for x in range(w):
            deviation[y, x] = math.sqrt(max(square_r[y, x] - mean_r[y, x] * mean_r[y, x], 0.0) + zero)
    warped = np.empty((h, w), np.float32)
    inside = np.empty((h, w), np.bool_)
    mean_s, square_s = np.empty((h, w), np.float32), np.empty((h, w), np.float32)
    mean_x, product = np.empty((h, w), np.float32), np.empty((h, w), np.float32)
    scores = np.empty((s, h, w), np.float32)
    for d in range(len(rhos)):
        for k in range(s):
            _warp(sources[k], h_inf[k], shift[k], rhos[d], warped, inside)
            _box_rows(warped, warped, _RADIUS, mean_s, square_s)
            _box_rows(warped, reference, _RADIUS, mean_x, product)
            for y in range(h):
                for x in range(w):
                    if not inside[y, x]:
                        scores[k, y, x] = -2.0
                        continue
                    variance = max(square_s[y, x] - mean_s[y, x] * mean_s[y, x], 0.0) + zero
                    covariance = product[y, x] - mean_s[y, x] * mean_r[y, x]
                    scores[k, y, x] = covariance / (math.sqrt(variance) * deviation[y, x])
        for y in range(h):
            for x in range(w):
                total, used = 0.0, 0
                for _ in range(keep):
                    best, at = -2.0, -1
                    for k in range(s):
                        if scores[k, y, x] > best:
                            best, at = scores[k, y, x], k
                    if at < 0:
                        break
                    scores[at, y, x] = -2.0
                    total += best
                    used += 1
                # One source alone may match by chance: it counts half.
                score = total / used if used > 1 else (0.5 * total if keep > 1 else total)
                out[y, x, d] = np.uint8(min(254.0, max(0.0, 127.0 * (1.0 - score))))
