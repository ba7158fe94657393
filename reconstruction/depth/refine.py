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
def _score(reference, sources, h_inf, shift, y, x, rho, gx, gy, zero, best):  # pragma: no cover - compiled
    """Correlate the slanted window at (y, x) with all sources; return the mean of the better half."""
    h, w = reference.shape
    s = sources.shape[0]
    sh, sw = sources.shape[1:]
    best[:] = -2.0
    for k in range(s):
        m = h_inf[k]
        t = shift[k]
        sa, sb, saa, sbb, sab, n = 0.0, 0.0, 0.0, 0.0, 0.0, 0
        good = True
        for dy in range(-_RADIUS, _RADIUS + 1, _STRIDE):
            j = y + dy
            if j < 0 or j >= h:
                continue
            for dx in range(-_RADIUS, _RADIUS + 1, _STRIDE):
                i = x + dx
                if i < 0 or i >= w:
                    continue
                px, py = i + 0.5, j + 0.5
                q = rho + gx * dx + gy * dy
                z = m[2, 0] * px + m[2, 1] * py + m[2, 2] + q * t[2]
                if z <= 1e-9:
                    good = False
                    break
                u = (m[0, 0] * px + m[0, 1] * py + m[0, 2] + q * t[0]) / z - 0.5
                v = (m[1, 0] * px + m[1, 1] * py + m[1, 2] + q * t[1]) / z - 0.5
                if not (u >= 0.0 and v >= 0.0 and u < sw - 1.001 and v < sh - 1.001):
                    if dx * dx + dy * dy <= 2:
                        good = False
                        break
                    continue
                ix, iy = int(u), int(v)
                fx, fy = u - ix, v - iy
                top = sources[k, iy, ix] * (1 - fx) + sources[k, iy, ix + 1] * fx
                low = sources[k, iy + 1, ix] * (1 - fx) + sources[k, iy + 1, ix + 1] * fx
                b = top * (1 - fy) + low * fy
                a = reference[j, i]
                sa += a
                sb += b
                saa += a * a
                sbb += b * b
                sab += a * b
                n += 1
            if not good:
                break
        if not good or n < 8:
            continue
        va, vb = max(saa / n - (sa / n) ** 2, 0.0) + zero, max(sbb / n - (sb / n) ** 2, 0.0) + zero
        best[k] = (sab / n - sa * sb / (n * n)) / math.sqrt(va * vb)
    keep = max(1, (s + 1) // 2)
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
def refine(
    reference, sources, h_inf, shift, rho, gx, gy, px_step, noise, out_rho, out_score
):  # pragma: no cover
    """Try inverse depths around `rho` (h, w) in steps of `px_step` pixels of disparity; keep the best, by parabola."""
    h, w = reference.shape
    s = sources.shape[0]
    zero = noise * noise
    best = np.empty(s)
    line = np.empty(5)
    for y in range(h):
        for x in range(w):
            r = rho[y, x]
            # Pixels of disparity per unit of inverse depth, in the source where it moves most.
            rate = 1e-12
            for k in range(s):
                m, t = h_inf[k], shift[k]
                px, py = x + 0.5, y + 0.5
                z = m[2, 0] * px + m[2, 1] * py + m[2, 2] + r * t[2]
                if z <= 1e-9:
                    continue
                u = (m[0, 0] * px + m[0, 1] * py + m[0, 2] + r * t[0]) / z
                v = (m[1, 0] * px + m[1, 1] * py + m[1, 2] + r * t[1]) / z
                rate = max(rate, math.hypot(t[0] - u * t[2], t[1] - v * t[2]) / z)
            step = px_step / rate
            top, at = -9.0, 2
            for c in range(5):
                q = r + (c - 2) * step
                line[c] = _score(reference, sources, h_inf, shift, y, x, q, gx[y, x], gy[y, x], zero, best)
                if q <= 0.0:
                    line[c] = -1.0
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
