"""Compiled semi-global aggregation of a cost volume along eight paths (Hirschmueller, PAMI 2008), and its winner."""

import numba
import numpy as np


@numba.njit(cache=True, nogil=True)
def _step(cost, previous, lowest, p1, p2, out, total):  # pragma: no cover - compiled
    """Update one pixel of a path: out[d] = cost[d] + least path cost of the previous pixel; return the new minimum."""
    planes = len(cost)
    jump = lowest + p2
    best = np.int32(1 << 30)
    for d in range(planes):
        way = min(np.int32(previous[d]), jump)
        if d > 0:
            way = min(way, np.int32(previous[d - 1]) + p1)
        if d < planes - 1:
            way = min(way, np.int32(previous[d + 1]) + p1)
        value = np.int32(cost[d]) + way - lowest
        out[d] = value
        total[d] += np.uint16(value)
        best = min(best, value)
    return best


@numba.njit(cache=True, nogil=True)
def aggregate(cost, image, p1, p2, floor, edge, total):  # pragma: no cover - compiled
    """Add the eight path costs of `cost` (h, w, planes) uint8 into `total` uint16.

    The penalty of a large change falls from p2 to `floor` as the image step grows beyond `edge` gray levels. With p1
    above p2 the planes are labels without order (a Potts model).
    """
    h, w, planes = cost.shape
    for direction in range(8):
        if direction == 0 or direction == 1:
            dx = 1 if direction == 0 else -1
            now, before = np.zeros(planes, np.int32), np.zeros(planes, np.int32)
            for y in range(h):
                x = 0 if dx > 0 else w - 1
                lowest = np.int32(0)
                before[:] = 0
                for i in range(w):
                    penalty = p2
                    if i > 0:
                        step = abs(image[y, x] - image[y, x - dx])
                        penalty = max(floor, np.int32(p2 / (1.0 + step / edge)))
                    lowest = _step(cost[y, x], before, lowest, p1, penalty, now, total[y, x])
                    now, before = before, now
                    x += dx
            continue
        dy = 1 if direction in (2, 4, 5) else -1
        dx = 0 if direction in (2, 3) else (1 if direction in (4, 6) else -1)
        rows = np.zeros((2, w, planes), np.int32)
        lows = np.zeros((2, w), np.int32)
        fresh = np.zeros(planes, np.int32)
        y = 0 if dy > 0 else h - 1
        for j in range(h):
            a, b = j & 1, 1 - (j & 1)
            for x in range(w):
                q = x - dx
                if j == 0 or q < 0 or q >= w:
                    lows[a, x] = _step(cost[y, x], fresh, np.int32(0), p1, p2, rows[a, x], total[y, x])
                else:
                    step = abs(image[y, x] - image[y - dy, q])
                    penalty = max(floor, np.int32(p2 / (1.0 + step / edge)))
                    lows[a, x] = _step(
                        cost[y, x], rows[b, q], lows[b, q], p1, penalty, rows[a, x], total[y, x]
                    )
            y += dy


@numba.njit(cache=True, nogil=True)
def winner(total, rhos, out):  # pragma: no cover - compiled
    """Write the inverse depth of the cheapest plane of each pixel, refined by a parabola, to `out` (h, w)."""
    h, w, planes = total.shape
    step = rhos[1] - rhos[0]
    for y in range(h):
        for x in range(w):
            best, at = np.int32(1 << 30), 0
            for d in range(planes):
                if total[y, x, d] < best:
                    best, at = np.int32(total[y, x, d]), d
            shift = 0.0
            if 0 < at < planes - 1:
                a, c = float(total[y, x, at - 1]), float(total[y, x, at + 1])
                bend = a + c - 2.0 * best
                if bend > 0:
                    shift = min(0.5, max(-0.5, 0.5 * (a - c) / bend))
            out[y, x] = rhos[at] + shift * step
