"""Put depth edges where the image has its edges.

A window that straddles the outline of a near thing correlates best at the depth of that thing, since the outline is
what stands out in it: every thing wears a skirt of its own depth, half a window wide, and all views agree on it.
Here each pixel beside a depth jump chooses anew among the surfaces around it. Evidence is the correlation of a window
in which only pixels of its own color count, and which surface the pixels of its color around it lie on.
"""

import math

import numba
import numpy as np

_REACH = 15  # pixels of the same color have a say from so far
_VOTE_STRIDE = 3
_MAX_CANDIDATES = 4
_RADIUS = 4  # 9x9 windows, every second pixel of them
_STRIDE = 2
_SAMPLES = ((2 * _RADIUS) // _STRIDE + 1) ** 2
_SAME = 0.012  # relative difference up to which two inverse depths are one surface
_WINDOW_TONE, _VOTE_TONE, _VOTE_PX = 10.0, 9.0, 11.0
_DOUBTED_SAY = 0.1
_STAY = 0.05


@numba.njit(cache=True, nogil=True)
def mark_doubt(rho, gx, gy, jump, band, doubt):  # pragma: no cover - compiled
    """Mark in doubt (h, w) the pixels within `band` of a jump of inverse depth that its slopes do not explain."""
    h, w = rho.shape
    wide = np.zeros((h, w), np.bool_)
    hit = np.zeros((h, w), np.bool_)
    for y in range(h - 1):
        for x in range(w - 1):
            r = rho[y, x]
            for side in range(2):
                j, i = y + side, x + 1 - side
                e = rho[j, i]
                if r <= 0.0 or e <= 0.0:
                    continue
                slope = max(abs(gy[y, x]), abs(gy[j, i])) if side == 1 else max(abs(gx[y, x]), abs(gx[j, i]))
                if abs(e - r) - min(slope, 0.02 * r) > jump * min(r, e):
                    hit[y, x] = True
    for y in range(h):
        last = -(1 << 20)
        for x in range(w):
            last = x if hit[y, x] else last
            wide[y, x] = x - last <= band + 1
        last = 1 << 20
        for x in range(w - 1, -1, -1):
            last = x if hit[y, x] else last
            wide[y, x] |= last - x <= band
    for x in range(w):
        last = -(1 << 20)
        for y in range(h):
            last = y if wide[y, x] else last
            doubt[y, x] = y - last <= band + 1
        last = 1 << 20
        for y in range(h - 1, -1, -1):
            last = y if wide[y, x] else last
            doubt[y, x] |= last - y <= band


@numba.njit(cache=True, nogil=True)
def _candidates(rho, gx, gy, doubt, y, x, out):  # pragma: no cover - compiled
    """Gather in out (m, 3) the surfaces around a pixel, extended to it: its own first, then those far from jumps."""
    h, w = rho.shape
    count = 0
    if rho[y, x] > 0.0:
        out[0, 0], out[0, 1], out[0, 2] = rho[y, x], gx[y, x], gy[y, x]
        count = 1
    for doubted in range(2):
        for reach in (5, 9, 13, 17):
            if doubted == 1 and reach > 10:
                break
            for dy in (-reach, 0, reach):
                for dx in (-reach, 0, reach):
                    j, i = y + dy, x + dx
                    if j < 0 or i < 0 or j >= h or i >= w or count == _MAX_CANDIDATES:
                        continue
                    if rho[j, i] <= 0.0 or doubt[j, i] != (doubted == 1):
                        continue
                    q = rho[j, i] - gx[j, i] * dx - gy[j, i] * dy
                    fresh = q > 0.0
                    for c in range(count):
                        if abs(q - out[c, 0]) < _SAME * out[c, 0]:
                            fresh = False
                            break
                    if fresh:
                        out[count, 0], out[count, 1], out[count, 2] = q, gx[j, i], gy[j, i]
                        count += 1
    return count


@numba.njit(cache=True, nogil=True)
def _vote(rho, score, color, doubt, y, x, candidates, count, votes):  # pragma: no cover - compiled
    """Count for each candidate surface the pixels of the same color around that lie on it; return all their say."""
    h, w = rho.shape
    votes[:] = 0.0
    total = 1e-6
    for dy in range(-_REACH, _REACH + 1, _VOTE_STRIDE):
        j = y + dy
        if j < 0 or j >= h:
            continue
        for dx in range(-_REACH, _REACH + 1, _VOTE_STRIDE):
            i = x + dx
            if i < 0 or i >= w or rho[j, i] <= 0.0:
                continue
            d = 0.0
            for a in range(3):
                d = max(d, abs(color[j, i, a] - color[y, x, a]))
            if d > 3.5 * _VOTE_TONE:
                continue
            q = math.exp(-0.5 * (d / _VOTE_TONE) ** 2 - 0.5 * (dx * dx + dy * dy) / (_VOTE_PX * _VOTE_PX))
            q *= max(0.15, score[j, i]) * (_DOUBTED_SAY if doubt[j, i] else 1.0)
            total += q
            for c in range(count):
                e = candidates[c, 0] + candidates[c, 1] * dx + candidates[c, 2] * dy
                if abs(rho[j, i] - e) < _SAME * e:
                    votes[c] += q
    return total


@numba.njit(cache=True, nogil=True)
def _window(reference, color, y, x, weight, values):  # pragma: no cover - compiled
    """Write weights (by likeness of color) and gray levels of the window; return weighted mean and variance."""
    h, w = reference.shape
    n, total = 0, np.float32(0.0)
    for dy in range(-_RADIUS, _RADIUS + 1, _STRIDE):
        j = min(max(y + dy, 0), h - 1)
        for dx in range(-_RADIUS, _RADIUS + 1, _STRIDE):
            i = min(max(x + dx, 0), w - 1)
            d = np.float32(0.0)
            for a in range(3):
                d = max(d, abs(color[j, i, a] - color[y, x, a]))
            q = math.exp(-d / _WINDOW_TONE - (dx * dx + dy * dy) / (2.0 * _RADIUS * _RADIUS))
            weight[n], values[n] = q, reference[j, i]
            total += np.float32(q)
            n += 1
    mean, variance = np.float32(0.0), np.float32(0.0)
    for n in range(_SAMPLES):
        weight[n] /= total
        mean += weight[n] * values[n]
    for n in range(_SAMPLES):
        variance += weight[n] * (values[n] - mean) ** 2
    return mean, variance


@numba.njit(cache=True, nogil=True)
def _correlation(values, weight, mean, variance, source, m, rho, gx, gy, zero):  # pragma: no cover - compiled
    """Weighted correlation of a slanted window with one source; -2 where the source does not see it."""
    sh, sw = source.shape
    top_u, top_v = np.float32(sw - 1.01), np.float32(sh - 1.01)
    one, half, nil = np.float32(1.0), np.float32(0.5), np.float32(0.0)
    u0, v0, z0 = m[0] + rho * m[9], m[1] + rho * m[10], m[2] + rho * m[11]
    if z0 <= np.float32(1e-9):
        return np.float32(-2.0)
    u, v = u0 / z0 - half, v0 / z0 - half
    if not (u >= nil and v >= nil and u < top_u and v < top_v):
        return np.float32(-2.0)
    ux, vx, zx = m[3] + gx * m[9], m[4] + gx * m[10], m[5] + gx * m[11]
    uy, vy, zy = m[6] + gy * m[9], m[7] + gy * m[10], m[8] + gy * m[11]
    sb, sbb, sab = nil, nil, nil
    n = 0
    for dy in range(-_RADIUS, _RADIUS + 1, _STRIDE):
        for dx in range(-_RADIUS, _RADIUS + 1, _STRIDE):
            q = weight[n]
            if q > np.float32(0.002):
                fx, fy = np.float32(dx), np.float32(dy)
                inv = one / (z0 + fx * zx + fy * zy)
                u = min(max(nil, (u0 + fx * ux + fy * uy) * inv - half), top_u)
                v = min(max(nil, (v0 + fx * vx + fy * vy) * inv - half), top_v)
                ix, iy = int(u), int(v)
                fx, fy = u - np.float32(ix), v - np.float32(iy)
                top = source[iy, ix] + fx * (source[iy, ix + 1] - source[iy, ix])
                low = source[iy + 1, ix] + fx * (source[iy + 1, ix + 1] - source[iy + 1, ix])
                b = top + fy * (low - top)
                sb += q * b
                sbb += q * b * b
                sab += q * (values[n] - mean) * b
            n += 1
    return sab / np.float32(math.sqrt((variance + zero) * (max(sbb - sb * sb, nil) + zero)))


@numba.njit(cache=True, nogil=True)
def _seen(values, weight, mean, variance, sources, maps, candidate, zero):  # pragma: no cover - compiled
    """Return the mean correlation of the two best sources: the others may not see the surface."""
    first, second = np.float32(-2.0), np.float32(-2.0)
    rho, gx, gy = candidate[0], candidate[1], candidate[2]
    for k in range(sources.shape[0]):
        s = _correlation(values, weight, mean, variance, sources[k], maps[k], rho, gx, gy, zero)
        second = max(second, min(first, s))
        first = max(first, s)
    if second > -1.5:
        return np.float32(0.5) * (first + second)
    return np.float32(0.5) * first if first > -1.5 else np.float32(-1.0)


@numba.njit(cache=True, nogil=True)
def resolve_edges(
    reference, color, sources, h_inf, shift, rho, gx, gy, score, doubt, noise, out, out_score
):  # pragma: no cover - compiled
    """Let pixels in doubt choose among the surfaces around them; where nothing was known they need good evidence.

    Args:
        reference: float32 (h, w) gray levels.
        color: float32 (h, w, 3).
        sources: float32 (s, h, w) gray levels of other frames.
        h_inf: (s, 3, 3) and `shift` (s, 3): a pixel p at inverse depth rho is at h_inf @ p + rho * shift.
        shift: See `h_inf`.
        rho: (h, w) inverse depth, 0 = unknown.
        gx: (h, w) its slope along x.
        gy: (h, w) its slope along y.
        score: (h, w) how sure each pixel is, 0 to 1.
        doubt: bool (h, w).
        noise: Image noise in gray levels.
        out: (h, w), written.
        out_score: (h, w), written: the correlation, for pixels that moved.
    """
    h, w = rho.shape
    zero = np.float32(noise * noise)
    maps = np.empty((sources.shape[0], 12), np.float32)
    weight, values = np.empty(_SAMPLES, np.float32), np.empty(_SAMPLES, np.float32)
    candidates = np.empty((_MAX_CANDIDATES, 3), np.float32)
    votes = np.empty(_MAX_CANDIDATES)
    for y in range(h):
        for x in range(w):
            known = rho[y, x] > 0.0
            out[y, x], out_score[y, x] = rho[y, x], score[y, x]
            if not doubt[y, x]:
                continue
            count = _candidates(rho, gx, gy, doubt, y, x, candidates)
            if count == 0 or (count == 1 and known):
                continue
            total = _vote(rho, score, color, doubt, y, x, candidates, count, votes)
            if known and votes[0] > 0.8 * total:
                continue
            for k in range(sources.shape[0]):
                for a in range(3):
                    maps[k, a] = h_inf[k, a, 0] * (x + 0.5) + h_inf[k, a, 1] * (y + 0.5) + h_inf[k, a, 2]
                    maps[k, 3 + a], maps[k, 6 + a] = h_inf[k, a, 0], h_inf[k, a, 1]
                    maps[k, 9 + a] = shift[k, a]
            mean, variance = _window(reference, color, y, x, weight, values)
            best, at, seen = -9.0, 0, np.float32(0.0)
            for c in range(count):
                own = known and c == 0
                if not own and votes[c] < 0.05 * total:
                    continue
                s = _seen(values, weight, mean, variance, sources, maps, candidates[c], zero)
                e = s + votes[c] / total + (_STAY if own else 0.0)
                if e > best:
                    best, at, seen = e, c, s
            if best <= -9.0 or (at == 0 and known):
                continue
            # Without texture only the neighbors of the same color speak, and they must agree among each other.
            if (known and (seen >= 0.3 or votes[at] >= 0.6 * total)) or (
                seen >= 0.5 and votes[at] >= 0.5 * total
            ):
                out[y, x], out_score[y, x] = candidates[at, 0], seen
