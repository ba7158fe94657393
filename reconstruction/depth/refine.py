"""Compiled local refinement of inverse depth with slanted windows, at depth resolution."""

import numba
import numpy as np

from reconstruction.depth.windows import FAST, make_correlate, offsets, project, source_maps

_RADIUS, _STRIDE = 3, 2  # 7x7 windows, every second pixel of them
_DX, _DY = offsets(_RADIUS, _STRIDE)
_SAMPLES = len(_DX)
_correlate = make_correlate(_SAMPLES)


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=FAST, forceinline=True)
def _gather(rho, here, jump, a, b, n, sx, sy, sr, sxx, syy, sxy, sxr, syr):  # pragma: no cover - compiled
    """Add to the sums of a row of pixels their neighbors (a, b) away, where those continue the surface."""
    one, nil = np.float32(1.0), np.float32(0.0)
    reach = np.float32(jump * max(1, abs(a) + abs(b)))
    a, b = np.float32(a), np.float32(b)
    for x in range(len(rho)):
        e = rho[x] - here[x]
        m = one if abs(e) <= reach * here[x] else nil
        e *= m
        n[x] += m
        sx[x] += a * m
        sy[x] += b * m
        sr[x] += e
        sxx[x] += a * a * m
        syy[x] += b * b * m
        sxy[x] += a * b * m
        sxr[x] += a * e
        syr[x] += b * e


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=FAST, forceinline=True)
def _solve(here, n, sx, sy, sr, sxx, syy, sxy, sxr, syr, rho, gx, gy):  # pragma: no cover - compiled
    """Turn the sums of a row of pixels into planes: value and slopes; pixels with few neighbors stay flat."""
    one, nil, few = np.float32(1.0), np.float32(0.0), np.float32(6.0)
    for x in range(len(here)):
        inv = one / n[x]
        xx, yy, xy = sxx[x] - sx[x] * sx[x] * inv, syy[x] - sy[x] * sy[x] * inv, sxy[x] - sx[x] * sy[x] * inv
        xr, yr = sxr[x] - sx[x] * sr[x] * inv, syr[x] - sy[x] * sr[x] * inv
        det = xx * yy - xy * xy
        many = n[x] >= few
        scale = one / det if many and det > one else nil
        a, b = (xr * yy - yr * xy) * scale, (yr * xx - xr * xy) * scale
        gx[x], gy[x] = a, b
        rho[x] = here[x] + ((sr[x] - a * sx[x] - b * sy[x]) * inv if many else nil)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def fit_slopes(rho, jump, out_rho, out_gx, out_gy):  # pragma: no cover - compiled
    """Fit a plane in inverse depth to the 5x5 neighbours that continue the surface; write its value and slopes."""
    h, w = rho.shape
    sums = np.empty((9, w), np.float32)
    s0, s1, s2, s3, s4, s5, s6, s7, s8 = (
        sums[0], sums[1], sums[2], sums[3], sums[4], sums[5], sums[6], sums[7], sums[8],
    )  # fmt: skip
    for y in range(h):
        sums[:] = 0.0
        for j in range(max(0, y - 2), min(h, y + 3)):
            for a in range(-2, 3):
                low, high = max(0, -a), w - max(0, a)
                n, sx, sy, sr = s0[low:high], s1[low:high], s2[low:high], s3[low:high]
                xx, yy, xy, xr, yr = s4[low:high], s5[low:high], s6[low:high], s7[low:high], s8[low:high]
                there, here = rho[j, low + a : high + a], rho[y, low:high]
                _gather(there, here, jump, a, j - y, n, sx, sy, sr, xx, yy, xy, xr, yr)
        _solve(rho[y], s0, s1, s2, s3, s4, s5, s6, s7, s8, out_rho[y], out_gx[y], out_gy[y])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _window(reference, y, x, centered, zero):  # pragma: no cover - compiled
    """Write what the window around (y, x), border repeated, differs from its mean; return its floored variance."""
    h, w = reference.shape
    s, q = np.float32(0.0), np.float32(0.0)
    n = 0
    for dy in range(-_RADIUS, _RADIUS + 1, _STRIDE):
        j = min(max(y + dy, 0), h - 1)
        for dx in range(-_RADIUS, _RADIUS + 1, _STRIDE):
            a = reference[j, min(max(x + dx, 0), w - 1)]
            centered[n] = a
            s += a
            q += a * a
            n += 1
    share = np.float32(1.0 / _SAMPLES)
    mean = s * share
    for n in range(_SAMPLES):
        centered[n] = (centered[n] - mean) * share
    return max(q * share - mean * mean, np.float32(0.0)) + zero


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _disparity_rate(maps, r):  # pragma: no cover - compiled
    """Return pixels of disparity per unit of inverse depth, in the source where it moves most."""
    rate = np.float32(1e-24)
    for k in range(len(maps)):
        m = maps[k]
        z = m[2] + r * m[11]
        if z > np.float32(1e-9):
            inv = np.float32(1.0) / z
            du = (m[9] - (m[0] + r * m[9]) * inv * m[11]) * inv
            dv = (m[10] - (m[1] + r * m[10]) * inv * m[11]) * inv
            rate = max(rate, du * du + dv * dv)
    return np.sqrt(rate)


@numba.njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _mean_of_seen(e, g):  # pragma: no cover - compiled
    """Return the mean of two correlations, or that of the one source that sees its pixel; -1 where none does."""
    none, half = np.float32(-2.0), np.float32(0.5)
    if e > none and g > none:
        return half * (e + g)
    return half * max(e, g) if e > none or g > none else np.float32(-1.0)


@numba.njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _peak(line):  # pragma: no cover - compiled
    """Return the place of the best of five tries, from -2 to 2 and between them by a parabola, and its worth."""
    half = np.float32(0.5)
    top, at = np.float32(-9.0), 2
    for c in range(5):
        # Where the windows say nothing, the aggregated depth stands.
        value = line[c] - np.float32(0.004 * abs(c - 2))
        if value > top:
            top, at = value, c
    moved = np.float32(0.0)
    if 0 < at < 4:
        bend = line[at - 1] + line[at + 1] - np.float32(2.0) * line[at]
        if bend < np.float32(-1e-4):
            moved = min(half, max(-half, half * (line[at - 1] - line[at + 1]) / bend))
    return np.float32(at - 2) + moved, line[at]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def refine(
    reference, sources, h_inf, shift, rho, gx, gy, px_step, thorough, noise, part, out_rho, out_score
):  # pragma: no cover
    """Try inverse depths around `rho` (h, w) in steps of `px_step` pixels of disparity; keep the best, by parabola.

    Two steps are tried to each side; if not `thorough`, the second one only where the first one is the best so far.
    Only `part` (top, bottom, left, right) of the frame is written: the sources are those of the part. A try's worth is
    the mean correlation with the two sources that see the unmoved window best: the others may not see it at all.
    """
    s, sh, sw = sources.shape
    flat = sources.reshape(s, sh * sw)
    zero, none = np.float32(noise * noise), np.float32(-2.0)
    px_step = np.float32(px_step)
    line, seen = np.empty(5, np.float32), np.empty(2, np.float32)
    maps = source_maps(h_inf, shift)
    weight = np.full(_SAMPLES, 1.0 / _SAMPLES).astype(np.float32)
    centered = np.empty(_SAMPLES, np.float32)
    dx, dy = _DX.copy(), _DY.copy()
    for y in range(part[0], part[1]):
        for x in range(part[2], part[3]):
            r, a, b = rho[y, x], gx[y, x], gy[y, x]
            project(h_inf, y, x, maps)
            variance = _window(reference, y, x, centered, zero)
            first, second, best, other = none, none, -1, -1
            for k in range(s):
                e = _correlate(weight, centered, variance, flat[k], sh, sw, maps[k], r, a, b, zero, dx, dy)
                if e > first:
                    second, other = first, best
                    first, best = e, k
                elif e > second:
                    second, other = e, k
            step = px_step / _disparity_rate(maps, r)
            line[:] = -1.0
            line[2] = _mean_of_seen(first, second)
            for at in (1, 3, 0, 4):
                q = r + np.float32(at - 2) * step
                if best < 0 or q <= np.float32(0.0):
                    continue
                nearer = line[1] if at < 2 else line[3]
                if (at == 0 or at == 4) and not thorough and nearer < max(line[1], line[2], line[3]):
                    continue
                seen[1] = none
                for n in range(2 if other >= 0 else 1):
                    k = other if n else best
                    seen[n] = _correlate(
                        weight, centered, variance, flat[k], sh, sw, maps[k], q, a, b, zero, dx, dy
                    )
                line[at] = _mean_of_seen(seen[0], seen[1])
            place, out_score[y, x] = _peak(line)
            out_rho[y, x] = r + place * step
