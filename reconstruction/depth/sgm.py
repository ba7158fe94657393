"""Compiled semi-global aggregation of a cost volume along eight paths (Hirschmueller, PAMI 2008), and its winner."""

import numba
import numpy as np

_NEVER = 12000  # the path cost of planes before the first and after the last: more than any, and p1 may be added to it
_PATHS = 4  # of either pass: along the row, and from three pixels of the row before it


@numba.njit(cache=True, nogil=True, forceinline=True)
def _step(cost, previous, lowest, p1, p2, out, total):  # pragma: no cover - compiled
    """Update one pixel of a path: out[d] = cost[d] + least path cost of the previous pixel; return the new minimum.

    In `previous` and `out` (planes + 2) the planes stand between two that are never the least.
    """
    jump, best = np.int16(lowest + p2), np.int16(_NEVER)
    for d in range(len(cost)):
        beside = np.int16(min(previous[d], previous[d + 2]) + p1)
        way = min(min(previous[d + 1], jump), beside)
        value = np.int16(np.int16(np.int16(cost[d]) + way) - lowest)
        out[d + 1] = value
        total[d] = np.uint16(total[d] + np.uint16(value))
        best = min(best, value)
    return best


@numba.njit(cache=True, nogil=True)
def aggregate(cost, image, p1, p2, floor, edge, total):  # pragma: no cover - compiled
    """Add the eight path costs of `cost` (h, w, planes) uint8 into `total` uint16.

    The penalty of a large change falls from p2 to `floor` as the image step grows beyond `edge` gray levels. With p1
    above p2 the planes are labels without order (a Potts model).
    """
    h, w, planes = cost.shape
    p1 = np.int16(p1)
    for way in (1, -1):  # from the first pixel to the last, then back
        # Paths start with no cost, beside the frame.
        rows = np.zeros((2, _PATHS, w + 2, planes + 2), np.int16)
        rows[..., 0] = _NEVER
        rows[..., planes + 1] = _NEVER
        lows = np.zeros((2, _PATHS, w + 2), np.int16)
        for j in range(h):
            y = j if way > 0 else h - 1 - j
            for i in range(w):
                x = i if way > 0 else w - 1 - i
                for path in range(_PATHS):
                    row, column = (j & 1, x - way) if path == 0 else (1 - (j & 1), x + (path - 2) * way)
                    above = y if path == 0 else y - way
                    penalty = p2
                    if 0 <= above < h and 0 <= column < w:
                        step = abs(image[y, x] - image[above, column])
                        penalty = max(floor, np.int32(p2 / (1.0 + step / edge)))
                    lows[j & 1, path, x + 1] = _step(
                        cost[y, x], rows[row, path, column + 1], lows[row, path, column + 1], p1, np.int16(penalty),
                        rows[j & 1, path, x + 1], total[y, x],
                    )  # fmt: skip


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


@numba.njit(cache=True, nogil=True)
def least_in_bins(cost, first, out):  # pragma: no cover - compiled
    """Write the least of costs (h, w, planes) from plane first[b] to before first[b + 1] to out (h, w, bins)."""
    h, w, bins = out.shape
    for y in range(h):
        for x in range(w):
            for b in range(bins):
                least = cost[y, x, first[b]]
                for d in range(first[b] + 1, first[b + 1]):
                    least = min(least, cost[y, x, d])
                out[y, x, b] = least


@numba.njit(cache=True, nogil=True)
def score_bins(total, hopeless, out):  # pragma: no cover - compiled
    """Write 255 for the cheapest bin of `total` uint16 (h, w, bins), less for others, 0 from `hopeless` behind it."""
    h, w, bins = out.shape
    one = np.float32(1.0)
    for y in range(h):
        for x in range(w):
            least = total[y, x, 0]
            for b in range(bins):
                least = min(least, total[y, x, b])
            for b in range(bins):
                behind = np.float32(np.uint16(total[y, x, b] - least)) / hopeless
                out[y, x, b] = np.uint8(np.int32(np.float32(255.0) * (one - min(behind, one))))
