"""Compiled kernels that move depth edges to image edges: adaptive support weights against edge fattening.

A stereo window that straddles an occlusion boundary correlates best at the foreground's depth, in all views alike.
Each pixel beside a depth jump therefore chooses among the surfaces around it, by the correlation of a window weighted
by color (adaptive support weights, Yoon and Kweon, PAMI 2006) and by the surfaces of nearby pixels of its color.
"""

import numba
import numpy as np

from reconstruction.depth.votes import SAME, make_votes, voters
from reconstruction.depth.windows import make_correlate, offsets, project, source_maps

_REACH = 15  # pixels of the same color vote within this distance
_MAX_CANDIDATES = 4
_RADIUS = 4  # 9x9 windows, every second pixel of them
_STRIDE = 2
_DX, _DY = offsets(_RADIUS, _STRIDE)
_SAMPLES = len(_DX)
_correlate = make_correlate(_SAMPLES)
_votes = make_votes(_REACH, stride=3, tone=9.0, most_tone=31.5, px=11.0)
_WINDOW_TONE = 10.0
_DOUBTED_SAY = 0.1
_STAY = 0.05
# Weights of samples by difference of color (whole levels) and by place.
_SAMPLE_BY_TONE = np.exp(-np.arange(256) / _WINDOW_TONE).astype(np.float32)
_SAMPLE_BY_PLACE = np.exp(-(_DX**2 + _DY**2) / (2.0 * _RADIUS * _RADIUS)).astype(np.float32)


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


def edge_voters(rho: np.ndarray, score: np.ndarray, doubt: np.ndarray, color: np.ndarray) -> np.ndarray:
    """Return the voters of `resolve_edges`, float32 (5, h + 30, w + 30), from maps (h, w); see `votes.voters`."""
    return voters(rho, score, doubt, _DOUBTED_SAY, color, _REACH)


@numba.njit(cache=True, nogil=True)
def _candidates(rho, gx, gy, doubt, y, x, out):  # pragma: no cover - compiled
    """Write the surfaces around a pixel, extended to it, to out (m, 3): its own first, then those far from jumps."""
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
                        if abs(q - out[c, 0]) < SAME * out[c, 0]:
                            fresh = False
                            break
                    if fresh:
                        out[count, 0], out[count, 1], out[count, 2] = q, gx[j, i], gy[j, i]
                        count += 1
    return count


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _differ(color, j, i, y, x):  # pragma: no cover - compiled
    """Return by how many levels two pixels differ, in the channel where they differ most."""
    d = abs(color[j, i, 0] - color[y, x, 0])
    d = max(d, abs(color[j, i, 1] - color[y, x, 1]))
    return int(max(d, abs(color[j, i, 2] - color[y, x, 2])))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _window(reference, color, y, x, weight, centered):  # pragma: no cover - compiled
    """Write the window's weights (by likeness of color), and weighted gray levels less their mean; return variance."""
    h, w = reference.shape
    n, total, mean = 0, np.float32(0.0), np.float32(0.0)
    for dy in range(-_RADIUS, _RADIUS + 1, _STRIDE):
        j = min(max(y + dy, 0), h - 1)
        for dx in range(-_RADIUS, _RADIUS + 1, _STRIDE):
            i = min(max(x + dx, 0), w - 1)
            q = _SAMPLE_BY_TONE[_differ(color, j, i, y, x)] * _SAMPLE_BY_PLACE[n]
            weight[n], centered[n] = q, reference[j, i]
            total += q
            mean += q * reference[j, i]
            n += 1
    share, variance = np.float32(1.0) / total, np.float32(0.0)
    mean *= share
    for n in range(_SAMPLES):
        weight[n] *= share
        e = centered[n] - mean
        centered[n] = weight[n] * e
        variance += weight[n] * e * e
    return variance


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _seen(
    weight, centered, variance, flat, sh, sw, maps, candidate, zero, dx, dy
):  # pragma: no cover - compiled
    """Return the mean correlation of the two best sources: the others may not see the surface."""
    first, second = np.float32(-2.0), np.float32(-2.0)
    r, gx, gy = candidate[0], candidate[1], candidate[2]
    for k in range(len(maps)):
        s = _correlate(weight, centered, variance, flat[k], sh, sw, maps[k], r, gx, gy, zero, dx, dy)
        second = max(second, min(first, s))
        first = max(first, s)
    if second > -1.5:
        return np.float32(0.5) * (first + second)
    return np.float32(0.5) * first if first > -1.5 else np.float32(-1.0)


@numba.njit(cache=True, nogil=True)
def resolve_edges(
    reference, color, sources, h_inf, shift, rho, gx, gy, score, doubt, voting, noise, part, out, out_score
):  # pragma: no cover - compiled
    """Reassign pixels in doubt to one of the surfaces around them; unknown pixels need stronger evidence.

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
        voting: Of `edge_voters`.
        noise: Image noise in gray levels.
        part: Top, bottom, left and right of the part of the frame that is written: the sources are those of the part.
        out: (h, w), written.
        out_score: (h, w), written: the correlation, for pixels that moved.
    """
    zero = np.float32(noise * noise)
    s, sh, sw = sources.shape
    flat = sources.reshape(s, sh * sw)
    maps = source_maps(h_inf, shift)
    dx, dy = _DX.copy(), _DY.copy()
    weight, centered = np.empty(_SAMPLES, np.float32), np.empty(_SAMPLES, np.float32)
    maps_voting, width = voting.reshape(len(voting), -1), voting.shape[2]
    candidates = np.empty((_MAX_CANDIDATES, 3), np.float32)
    votes = np.empty(_MAX_CANDIDATES, np.float32)
    for y in range(part[0], part[1]):
        for x in range(part[2], part[3]):
            known = rho[y, x] > 0.0
            out[y, x], out_score[y, x] = rho[y, x], score[y, x]
            if not doubt[y, x]:
                continue
            count = _candidates(rho, gx, gy, doubt, y, x, candidates)
            if count == 0 or (count == 1 and known):
                continue
            total = _votes(maps_voting, width, y, x, candidates, count, votes)
            if known and votes[0] > 0.8 * total:
                continue
            project(h_inf, y, x, maps)
            variance = _window(reference, color, y, x, weight, centered) + zero
            best, at, seen = -9.0, 0, np.float32(0.0)
            for c in range(count):
                own = known and c == 0
                if not own and votes[c] < 0.05 * total:
                    continue
                say = _seen(weight, centered, variance, flat, sh, sw, maps, candidates[c], zero, dx, dy)
                e = say + votes[c] / total + (_STAY if own else 0.0)
                if e > best:
                    best, at, seen = e, c, say
            if best <= -9.0 or (at == 0 and known):
                continue
            # Without texture only the neighbors of the same color speak, and they must agree among each other.
            if (known and (seen >= 0.3 or votes[at] >= 0.6 * total)) or (
                seen >= 0.5 and votes[at] >= 0.5 * total
            ):
                out[y, x], out_score[y, x] = candidates[at, 0], seen
