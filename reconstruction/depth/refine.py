"""Local refinement of inverse depth with windows slanted like the surface, at full depth resolution."""

import math

import numba
import numpy as np

_RADIUS = 3  # 7x7 windows, every second pixel of them
_STRIDE = 2


@numba.njit(cache=True, nogil=True)
def fit_slopes(rho, jump, out_rho, out_gx, out_gy):  # pragma: no cover - compiled
    """Fit a plane in inverse depth to the 5x5 neighbours that continue the surface; write its value and slopes."""
    h, w = rho.shape
    for y in range(h):
        for x in range(w):
            r = rho[y, x]
            n, sx, sy, sr, sxx, syy, sxy, sxr, syr = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            for j in range(max(0, y - 2), min(h, y + 3)):
                for i in range(max(0, x - 2), min(w, x + 3)):
                    e = rho[j, i] - r
                    if abs(e) > jump * r * max(1, abs(i - x) + abs(j - y)):
                        continue
                    a, b = i - x, j - y
                    n += 1.0
                    sx += a
                    sy += b
                    sr += e
                    sxx += a * a
                    syy += b * b
                    sxy += a * b
                    sxr += a * e
                    syr += b * e
            sxx -= sx * sx / n
            syy -= sy * sy / n
            sxy -= sx * sy / n
            sxr -= sx * sr / n
            syr -= sy * sr / n
            det = sxx * syy - sxy * sxy
            gx, gy = 0.0, 0.0
            if n >= 6.0 and det > 1.0:
                gx, gy = (sxr * syy - syr * sxy) / det, (syr * sxx - sxr * sxy) / det
            out_gx[y, x], out_gy[y, x] = gx, gy
            out_rho[y, x] = r + sr / n - gx * sx / n - gy * sy / n if n >= 6.0 else r


@numba.njit(cache=True, nogil=True)
def _window(reference, y, x, values, zero):  # pragma: no cover - compiled
    """Copy the reference window around (y, x), border repeated; return its mean and floored variance."""
    h, w = reference.shape
    s, q = np.float32(0.0), np.float32(0.0)
    n = 0
    for dy in range(-_RADIUS, _RADIUS + 1, _STRIDE):
        j = min(max(y + dy, 0), h - 1)
        for dx in range(-_RADIUS, _RADIUS + 1, _STRIDE):
            a = reference[j, min(max(x + dx, 0), w - 1)]
            values[n] = a
            s += a
            q += a * a
            n += 1
    mean = s / n
    return mean, max(q / n - mean * mean, np.float32(0.0)) + zero


@numba.njit(cache=True, nogil=True)
def _score(values, mean, variance, sources, maps, rho, gx, gy, zero, best):  # pragma: no cover - compiled
    """Correlate a slanted window with all sources; return the mean of the two best.

    `maps` (s, 12) holds, for each source, the projection of the pixel and its change along x, y and inverse depth:
    over the window the numerators and the denominator are affine, which makes a sample cheap.
    """
    s = sources.shape[0]
    sh, sw = sources.shape[1:]
    top_u, top_v = np.float32(sw - 1.01), np.float32(sh - 1.01)
    one, half, nil = np.float32(1.0), np.float32(0.5), np.float32(0.0)
    count = np.float32(((2 * _RADIUS) // _STRIDE + 1) ** 2)
    for k in range(s):
        m = maps[k]
        best[k] = -2.0
        tx, ty, tz = m[9], m[10], m[11]
        u0, v0, z0 = m[0] + rho * tx, m[1] + rho * ty, m[2] + rho * tz
        if z0 <= np.float32(1e-9):
            continue
        u, v = u0 / z0 - half, v0 / z0 - half
        if not (u >= nil and v >= nil and u < top_u and v < top_v):
            continue
        ux, vx, zx = m[3] + gx * tx, m[4] + gx * ty, m[5] + gx * tz
        uy, vy, zy = m[6] + gy * tx, m[7] + gy * ty, m[8] + gy * tz
        sb, sbb, sab = nil, nil, nil
        n = 0
        for dy in range(-_RADIUS, _RADIUS + 1, _STRIDE):
            for dx in range(-_RADIUS, _RADIUS + 1, _STRIDE):
                fx, fy = np.float32(dx), np.float32(dy)
                inv = one / (z0 + fx * zx + fy * zy)
                u = (u0 + fx * ux + fy * uy) * inv - half
                v = (v0 + fx * vx + fy * vy) * inv - half
                # Comparisons in this order also catch what is not a number.
                u = min(max(nil, u), top_u)
                v = min(max(nil, v), top_v)
                ix, iy = int(u), int(v)
                fx, fy = u - np.float32(ix), v - np.float32(iy)
                top = sources[k, iy, ix] + fx * (sources[k, iy, ix + 1] - sources[k, iy, ix])
                low = sources[k, iy + 1, ix] + fx * (sources[k, iy + 1, ix + 1] - sources[k, iy + 1, ix])
                b = top + fy * (low - top)
                sb += b
                sbb += b * b
                sab += values[n] * b
                n += 1
        mb = sb / count
        vb = max(sbb / count - mb * mb, nil) + zero
        best[k] = (sab / count - mean * mb) / math.sqrt(variance * vb)
    keep = min(2, s)
    total, used = 0.0, 0
    for _ in range(keep):
        at = int(np.argmax(best))
        if best[at] <= -2.0:
            break
        total += best[at]
        best[at] = -2.0
        used += 1
    if used == 0:
        return -1.0
    return total / used if used == keep else 0.5 * total / used


@numba.njit(cache=True, nogil=True)
def _maps(h_inf, shift, y, x, maps):  # pragma: no cover - compiled
    for k in range(h_inf.shape[0]):
        for a in range(3):
            maps[k, a] = h_inf[k, a, 0] * (x + 0.5) + h_inf[k, a, 1] * (y + 0.5) + h_inf[k, a, 2]
            maps[k, 3 + a] = h_inf[k, a, 0]
            maps[k, 6 + a] = h_inf[k, a, 1]
            maps[k, 9 + a] = shift[k, a]


@numba.njit(cache=True, nogil=True)
def refine(
    reference, sources, h_inf, shift, rho, gx, gy, px_step, noise, out_rho, out_score
):  # pragma: no cover
    """Try inverse depths around `rho` (h, w) in steps of `px_step` pixels of disparity; keep the best, by parabola."""
    h, w = reference.shape
    s = sources.shape[0]
    zero = np.float32(noise * noise)
    best = np.empty(s)
    line = np.empty(5)
    maps = np.empty((s, 12), np.float32)
    values = np.empty(((2 * _RADIUS) // _STRIDE + 1) ** 2, np.float32)
    for y in range(h):
        for x in range(w):
            r = rho[y, x]
            _maps(h_inf, shift, y, x, maps)
            # Pixels of disparity per unit of inverse depth, in the source where it moves most.
            rate = 1e-12
            for k in range(s):
                m = maps[k]
                z = m[2] + r * m[11]
                if z > 1e-9:
                    u, v = (m[0] + r * m[9]) / z, (m[1] + r * m[10]) / z
                    rate = max(rate, math.hypot(m[9] - u * m[11], m[10] - v * m[11]) / z)
            step = px_step / rate
            mean, variance = _window(reference, y, x, values, zero)
            top, at = -9.0, 2
            for c in range(5):
                q = np.float32(r + (c - 2) * step)
                line[c] = -1.0
                if q > 0.0:
                    line[c] = _score(values, mean, variance, sources, maps, q, gx[y, x], gy[y, x], zero, best)
                # Where the windows say nothing, the aggregated depth stands.
                if line[c] - 0.004 * abs(c - 2) > top:
                    top, at = line[c] - 0.004 * abs(c - 2), c
            moved = 0.0
            if 0 < at < 4:
                bend = line[at - 1] + line[at + 1] - 2.0 * line[at]
                if bend < -1e-4:
                    moved = min(0.5, max(-0.5, 0.5 * (line[at - 1] - line[at + 1]) / bend))
            out_rho[y, x] = r + (at - 2 + moved) * step
            out_score[y, x] = line[at]
