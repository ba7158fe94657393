"""Votes on a pixel's surface by the pixels around it that have its color: the inner loop of moving depth edges.

Voters stand on a grid around their pixel. Maps are padded with voters that have no say, so that the loops over voters
are free of branches, which lets them run on vector units.
"""

import numba
import numpy as np

from reconstruction.depth.vector_memory import load_only_read, store_apart
from reconstruction.depth.windows import FAST, fill_vectors, offsets

_LEVELS = np.arange(256)
_LEAST_SAY = np.float32(0.15)  # of pixels whose window correlates with nothing
SAME = 0.012
"""Relative difference up to which two inverse depths are one surface."""


def voters(
    rho: np.ndarray, score: np.ndarray, doubt: np.ndarray, doubted_say: float, color: np.ndarray, reach: int
):
    """Return inverse depth, say and color of every pixel as voter, float32 (5, h + 2 reach, w + 2 reach).

    Args:
        rho: (h, w) inverse depth, 0 = unknown: no say.
        score: (h, w) how sure each pixel is, 0 to 1.
        doubt: bool (h, w) pixels whose say counts `doubted_say` only.
        doubted_say: See `doubt`.
        color: float32 (h, w, 3).
        reach: Pixels of the margin.
    """
    say = np.maximum(_LEAST_SAY, score) * np.where(doubt, np.float32(doubted_say), np.float32(1)) * (rho > 0)
    out = np.zeros((5, rho.shape[0] + 2 * reach, rho.shape[1] + 2 * reach), np.float32)
    inside = out[:, reach:-reach, reach:-reach]
    inside[0], inside[1], inside[2:] = rho, say, np.moveaxis(color, 2, 0)
    return out


def make_votes(reach: int, stride: int, tone: float, most_tone: float, px: float):
    """Compile the votes of a grid of voters up to `reach` pixels away: a loop of known length runs on vector units.

    A vote counts less the more its color differs (`tone` levels; none from `most_tone` on) and with distance (`px`).
    """
    grid_x, grid_y = offsets(reach, stride)
    by_tone = np.where(most_tone < _LEVELS, 0, np.exp(-0.5 * (_LEVELS / tone) ** 2)).astype(np.float32)
    by_place = np.exp(-0.5 * (grid_x**2 + grid_y**2) / px**2).astype(np.float32)
    grid_x, grid_y, by_place = (fill_vectors(values) for values in (grid_x, grid_y, by_place))
    samples = len(by_place)

    @numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=FAST, forceinline=True)
    def votes(maps, width, y, x, candidates, count, out):  # pragma: no cover - compiled
        """Write the weights of the voters around (y, x) on each candidate surface to `out`; return that of all.

        Args:
            maps: (5, height * width), `voters`, flattened.
            width: Of the maps, with their margin.
            y: Row of the pixel, without margin.
            x: Its column.
            candidates: float32 (m, 3) inverse depth and slopes.
            count: Of the candidates.
            out: float32 (m,), written.
        """
        dx, dy, place, tones = grid_x, grid_y, by_place, by_tone
        rho, say, red, green, blue = maps[0], maps[1], maps[2], maps[3], maps[4]
        here = np.int32((y + reach) * width + x + reach)
        r, g, b = red[here], green[here], blue[here]
        weight, depth = np.empty(samples, np.float32), np.empty(samples, np.float32)
        total = np.float32(1e-6)
        for n in range(samples):
            at = np.uint32(here + np.int32(dy[n]) * np.int32(width) + np.int32(dx[n]))
            d = max(abs(load_only_read(red, at) - r), abs(load_only_read(green, at) - g))  # pyright: ignore[reportCallIssue]
            d = max(d, abs(load_only_read(blue, at) - b))
            q = load_only_read(tones, np.uint32(np.int32(d))) * place[n] * load_only_read(say, at)
            total += q
            store_apart(weight, n, q)
            store_apart(depth, n, load_only_read(rho, at))
        for c in range(count):
            q, gx, gy = candidates[c, 0], candidates[c, 1], candidates[c, 2]
            own = np.float32(0.0)
            for n in range(samples):
                expected = q + gx * dx[n] + gy * dy[n]
                agrees = abs(depth[n] - expected) < np.float32(SAME) * expected
                own += weight[n] if agrees else np.float32(0.0)
            out[c] = own
        return total

    return votes
