"""Compiled per-cell statistics of walls' pictures."""

import numpy as np
from numba import njit, prange


@njit(cache=True, parallel=True)
def median_colors(stack, valid):  # pragma: no cover - compiled
    """Return the median color uint8 (h, w, 3) of frames uint8 (n, h, w, 3) where they are valid, bool (n, h, w)."""
    frames, height, width = valid.shape
    out = np.zeros((height, width, 3), np.uint8)
    for y in prange(height):
        values = np.zeros(frames, np.uint8)
        for x in range(width):
            for channel in range(3):
                count = 0
                for k in range(frames):
                    if not valid[k, y, x]:
                        continue
                    value = stack[k, y, x, channel]
                    place = count
                    while place > 0 and values[place - 1] > value:
                        values[place] = values[place - 1]
                        place -= 1
                    values[place] = value
                    count += 1
                if count:
                    out[y, x, channel] = values[count // 2]
    return out
