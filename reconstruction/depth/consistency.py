"""Compiled kernels for consistency between depth maps: agreeing views, free space violations, speckles."""

import math

import numba
import numpy as np

from reconstruction.depth.reprojection import reproject


@numba.njit(cache=True, nogil=True)
def _sample(depth, u, v, tolerance):  # pragma: no cover - compiled
    """Return depth at pixel coordinates (u, v): bilinear on one surface, else of the nearest pixel; 0 = none."""
    h, w = depth.shape
    if not (u >= 0.0 and v >= 0.0 and u < w and v < h):
        return 0.0
    x, y = u - 0.5, v - 0.5
    x0, y0 = int(math.floor(x)), int(math.floor(y))
    if 0 <= x0 < w - 1 and 0 <= y0 < h - 1:
        a, b, c, d = depth[y0, x0], depth[y0, x0 + 1], depth[y0 + 1, x0], depth[y0 + 1, x0 + 1]
        low, high = min(min(a, b), min(c, d)), max(max(a, b), max(c, d))
        if low > 0.0 and high - low < tolerance * low:
            fx, fy = x - x0, y - y0
            return (a * (1 - fx) + b * fx) * (1 - fy) + (c * (1 - fx) + d * fx) * fy
    return float(depth[int(v), int(u)])


@numba.njit(cache=True, nogil=True)
def check_view(
    i, neighbors, depth, weight, relative, k, agree_depth, agree_px, count, fused
):  # pragma: no cover
    """Count the neighbors that agree with each pixel of view i (forward-backward reprojection), and fuse their depth.

    Args:
        i: Row of the view in `depth`.
        neighbors: (k,) rows, -1 = none.
        depth: (n, h, w).
        weight: (n, h, w) of each pixel in the mean.
        relative: (k, 4, 4) neighbour_from_view.
        k: fx, fy, cx, cy.
        agree_depth: Relative depth difference allowed.
        agree_px: Reprojection error allowed.
        count: (h, w) uint8, written.
        fused: (h, w) float32, written.
    """
    h, w = depth.shape[1:]
    fx, fy, cx, cy = k
    for y in range(h):
        for x in range(w):
            z = float(depth[i, y, x])
            if z <= 0.0:
                continue
            own = float(weight[i, y, x]) + 1e-3
            total, amount, agree = own / z, own, 0
            xn, yn = (x + 0.5 - cx) / fx, (y + 0.5 - cy) / fy
            for s in range(len(neighbors)):
                j = neighbors[s]
                if j < 0:
                    break
                m = relative[s]
                qz, u, v = reproject(m, k, xn, yn, z)
                d = _sample(depth[j], u, v, 0.03)
                if d <= 0.0 or abs(d - qz) > agree_depth * qz:
                    continue
                # Back again: where does the neighbour's point fall in this view, and how deep?
                bx, by = (u - cx) / fx * d - m[0, 3], (v - cy) / fy * d - m[1, 3]
                bz = d - m[2, 3]
                back_z = m[0, 2] * bx + m[1, 2] * by + m[2, 2] * bz
                if back_z <= 1e-9:
                    continue
                back_x = fx * (m[0, 0] * bx + m[1, 0] * by + m[2, 0] * bz) / back_z + cx - (x + 0.5)
                back_y = fy * (m[0, 1] * bx + m[1, 1] * by + m[2, 1] * bz) / back_z + cy - (y + 0.5)
                if back_x * back_x + back_y * back_y > agree_px * agree_px:
                    continue
                agree += 1
                q = float(weight[j, int(v), int(u)]) + 1e-3
                total += q / back_z
                amount += q
            count[y, x] = agree
            fused[y, x] = amount / total


@numba.njit(cache=True, nogil=True)
def count_witnesses(
    i, neighbors, depth, mask, relative, k, beyond, same, agree, through
):  # pragma: no cover - compiled
    """Count the neighbors that see the same point as each masked pixel of view i, and those that look through it.

    Args:
        i: Row of the view in `depth`.
        neighbors: (k,) rows, -1 = none.
        depth: (n, h, w).
        mask: bool (h, w) pixels to ask about.
        relative: (k, 4, 4) neighbour_from_view.
        k: fx, fy, cx, cy.
        beyond: Ratio of depths from which on a neighbor looks through the point.
        same: Relative difference up to which it sees the same.
        agree: (h, w) uint8, written.
        through: (h, w) uint8, written.
    """
    h, w = depth.shape[1:]
    fx, fy, cx, cy = k
    for y in range(h):
        for x in range(w):
            z = float(depth[i, y, x])
            if not mask[y, x] or z <= 0.0:
                continue
            xn, yn = (x + 0.5 - cx) / fx, (y + 0.5 - cy) / fy
            for s in range(len(neighbors)):
                j = neighbors[s]
                if j < 0:
                    break
                qz, u, v = reproject(relative[s], k, xn, yn, z)
                if not (u >= 0.0 and v >= 0.0 and u < w and v < h):
                    continue
                d = depth[j, int(v), int(u)]
                if d > beyond * qz:
                    through[y, x] += 1
                elif abs(d - qz) < same * qz:
                    agree[y, x] += 1


def remove_speckles(depth: np.ndarray, min_px: int, jump: float) -> np.ndarray:
    """Return a mask (h, w) of pixels in connected pieces of at least `min_px`, cut where depth jumps by `jump`."""
    label = np.zeros(depth.shape, np.int32)
    sizes = _label_pieces(depth, jump, label)
    return (depth > 0) & (sizes[label] >= min_px)


@numba.njit(cache=True, nogil=True)
def _label_pieces(depth, jump, label):  # pragma: no cover - compiled
    """Flood-fill pieces of continuous depth; return the size of each label (label 0 = no depth)."""
    h, w = depth.shape
    stack = np.empty(h * w, np.int64)
    sizes = np.zeros(h * w + 1, np.int64)
    count = 0
    for start in range(h * w):
        if depth[start // w, start % w] <= 0.0 or label[start // w, start % w] != 0:
            continue
        count += 1
        label[start // w, start % w] = count
        stack[0] = start
        top = 1
        while top > 0:
            top -= 1
            at = stack[top]
            sizes[count] += 1
            y, x = at // w, at % w
            for side in range(4):
                j, i = y + (side == 0) - (side == 1), x + (side == 2) - (side == 3)
                if j < 0 or i < 0 or j >= h or i >= w or depth[j, i] <= 0.0 or label[j, i] != 0:
                    continue
                if abs(depth[j, i] - depth[y, x]) > jump * depth[y, x]:
                    continue
                label[j, i] = count
                stack[top] = j * w + i
                top += 1
    return sizes[: count + 1]
