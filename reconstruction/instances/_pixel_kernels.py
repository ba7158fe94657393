"""Compiled refinement of id maps."""

import numpy as np
from numba import njit, prange


@njit(cache=True, parallel=True)
def snap_borders(ids, band, lab, depth, radius, reach):  # pragma: no cover - compiled
    """Reassign pixels near id borders to the nearby id with the most similar color and depth; return uint16 (h, w).

    One loop over pixels and one over their neighbors, so that no array per id is needed.

    Args:
        ids: uint16 (h, w).
        band: bool (h, w) pixels to reassign.
        lab: float32 (h, w, 3) CIELAB.
        depth: float32 (h, w) measured depth, 0 = unknown.
        radius: a pixel may take ids that occur within this distance, in pixels.
        reach: color and depth of an id are means over its pixels outside of `band` within this distance, in pixels.
    """
    height, width = ids.shape
    out = ids.copy()
    for y in prange(height):
        names = np.zeros(8, np.int64)
        count = np.zeros(8)
        near = np.zeros(8)
        sums = np.zeros((8, 3))
        depths = np.zeros(8)
        depth_count = np.zeros(8)
        for x in range(width):
            if not band[y, x]:
                continue
            used = 0
            for dy in range(-reach, reach + 1):
                yy = y + dy
                if yy < 0 or yy >= height:
                    continue
                for dx in range(-reach, reach + 1):
                    xx = x + dx
                    if xx < 0 or xx >= width:
                        continue
                    close = dy * dy + dx * dx <= radius * radius
                    if band[yy, xx] and not close:
                        continue
                    name = ids[yy, xx]
                    slot = -1
                    for k in range(used):
                        if names[k] == name:
                            slot = k
                    if slot < 0:
                        if used == 8:
                            continue
                        slot = used
                        names[slot] = name
                        count[slot] = 0.0
                        near[slot] = 0.0
                        depths[slot] = 0.0
                        depth_count[slot] = 0.0
                        for c in range(3):
                            sums[slot, c] = 0.0
                        used += 1
                    if close:
                        near[slot] += 1.0
                    if not band[yy, xx]:
                        w = 1.0 / (1.0 + 0.1 * (dy * dy + dx * dx))
                        count[slot] += w
                        for c in range(3):
                            sums[slot, c] += w * lab[yy, xx, c]
                        if depth[yy, xx] > 0:
                            depths[slot] += w * depth[yy, xx]
                            depth_count[slot] += w
            best = 1e30
            for k in range(used):
                if near[k] == 0.0 or count[k] == 0.0:
                    continue
                cost = 0.0
                for c in range(3):
                    cost += (lab[y, x, c] - sums[k, c] / count[k]) ** 2
                cost = min(np.sqrt(cost) / 10.0, 4.0)
                if depth[y, x] > 0 and depth_count[k] > 0:
                    mean = depths[k] / depth_count[k]
                    cost += 0.7 * min(abs(depth[y, x] - mean) / (0.02 * mean), 2.0)
                if names[k] != ids[y, x]:
                    cost += 0.5
                if cost < best:
                    best = cost
                    out[y, x] = names[k]
    return out
