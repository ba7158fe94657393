"""Consistency between depth maps: agreeing views, free space violations, speckles.

The kernels take the pixels of a row together and compare them with one view after the other, in loops without branches
that run on vector units.
"""

import numba
import numpy as np

from reconstruction.depth.vector_memory import load_only_read, store_apart
from reconstruction.depth.windows import FAST
from registry.geometry import invert_rigid

_ONE_SURFACE = 0.03  # relative difference of depths up to which those of four pixels are interpolated


def _pixel_maps(relative: np.ndarray, k) -> np.ndarray:
    """Return maps float32 (k, 3, 4) from pixels and depths of one view to those of others.

    Pixel (u, v) with z-depth z is seen by the other view where m @ (u z, v z, z, 1) = (u' z', v' z', z').

    Args:
        relative: (k, 4, 4) other_from_view.
        k: fx, fy, cx, cy of all views.
    """
    fx, fy, cx, cy = k
    camera = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    turn = camera @ relative[:, :3, :3] @ np.linalg.inv(camera)
    return np.concatenate([turn, camera @ relative[:, :3, 3:]], axis=2).astype(np.float32)


@numba.njit(cache=True, nogil=True)
def _gather(depth, mask, columns, z):  # pragma: no cover - compiled
    """Write columns and depths of the masked pixels of a row that have depth; return how many these are."""
    count = 0
    for x in range(len(depth)):
        if mask[x] and depth[x] > 0.0:
            columns[count], z[count] = x, depth[x]
            count += 1
    return count


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=FAST, forceinline=True)
def _meet(m, columns, z, y, u, v, there):  # pragma: no cover - compiled
    """Write where another view sees pixels (m,) of row y: coordinates and depth; u = -1 where it does not."""
    half, least = np.float32(0.5), np.float32(1e-9)
    y = np.float32(y) + half
    ax, bx, tx = m[0, 0], m[0, 1] * y + m[0, 2], m[0, 3]
    ay, by, ty = m[1, 0], m[1, 1] * y + m[1, 2], m[1, 3]
    az, bz, tz = m[2, 0], m[2, 1] * y + m[2, 2], m[2, 3]
    for n in range(len(z)):
        x = np.float32(columns[n]) + half
        depth = z[n] * (az * x + bz) + tz
        inverse = np.float32(1.0) / max(depth, least)
        u[n] = (z[n] * (ax * x + bx) + tx) * inverse if depth > least else np.float32(-1.0)
        v[n] = (z[n] * (ay * x + by) + ty) * inverse
        there[n] = depth


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=FAST, forceinline=True)
def _sample_row(depth, weight, width, height, u, v, d, q):  # pragma: no cover - compiled
    """Write depth of a map at pixel coordinates (m,): bilinear on one surface, else of the nearest pixel; 0 = none.

    `depth` and `weight` are (height * width,); the weight q is that of the nearest pixel.
    """
    nil, half, one = np.float32(0.0), np.float32(0.5), np.float32(1.0)
    top_u, top_v = np.float32(width - 1.001), np.float32(height - 1.001)
    w, h, stride, right, below = (
        np.float32(width),
        np.float32(height),
        np.int32(width),
        np.uint32(1),
        np.uint32(width),
    )
    for n in range(len(d)):
        seen = (u[n] >= nil) & (v[n] >= nil) & (u[n] < w) & (v[n] < h)
        x, y = min(max(nil, u[n] - half), top_u), min(max(nil, v[n] - half), top_v)
        ix, iy = np.int32(x), np.int32(y)
        fx, fy = x - np.float32(ix), y - np.float32(iy)
        p = np.uint32(iy * stride + ix)
        a, b = load_only_read(depth, p), load_only_read(depth, p + right)  # pyright: ignore[reportCallIssue]
        c, e = load_only_read(depth, p + below), load_only_read(depth, p + below + right)  # pyright: ignore[reportCallIssue]
        low, high = min(min(a, b), min(c, e)), max(max(a, b), max(c, e))
        smooth = (a * (one - fx) + b * fx) * (one - fy) + (c * (one - fx) + e * fx) * fy
        upper, lower = b if fx >= half else a, e if fx >= half else c
        nearest = lower if fy >= half else upper
        value = smooth if (low > nil) & (high - low < np.float32(_ONE_SURFACE) * low) else nearest
        p += (right if fx >= half else np.uint32(0)) + (below if fy >= half else np.uint32(0))
        store_apart(d, n, value if seen else nil)
        store_apart(q, n, load_only_read(weight, p) + np.float32(1e-3))  # pyright: ignore[reportCallIssue]


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=FAST, forceinline=True)
def _agree_row(
    back, columns, y, u, v, there, d, q, agree_depth, agree_px, agree, total, amount
):  # pragma: no cover
    """Add what another view sees to the sums of pixels (m,) of row y, where it agrees."""
    nil, half, one = np.float32(0.0), np.float32(0.5), np.float32(1.0)
    y = np.float32(y) + half
    ax, bx, cx, tx = back[0, 0], back[0, 1], back[0, 2], back[0, 3]
    ay, by, cy, ty = back[1, 0], back[1, 1], back[1, 2], back[1, 3]
    az, bz, cz, tz = back[2, 0], back[2, 1], back[2, 2], back[2, 3]
    for n in range(len(d)):
        # Back again: where does the other view's point fall in this view, and how deep?
        z = d[n] * (az * u[n] + bz * v[n] + cz) + tz
        inverse = one / max(z, np.float32(1e-9))
        off_x = (d[n] * (ax * u[n] + bx * v[n] + cx) + tx) * inverse - (np.float32(columns[n]) + half)
        off_y = (d[n] * (ay * u[n] + by * v[n] + cy) + ty) * inverse - y
        same = (d[n] > nil) & (abs(d[n] - there[n]) <= agree_depth * there[n]) & (z > np.float32(1e-9))
        say = q[n] if same & (off_x * off_x + off_y * off_y <= agree_px * agree_px) else nil
        agree[n] += one if say > nil else nil
        amount[n] += say
        total[n] += say * inverse


@numba.njit(cache=True, nogil=True)
def _check(
    i, neighbors, depth, weight, mask, maps, backs, agree_depth, agree_px, count, fused
):  # pragma: no cover - compiled
    n, h, w = depth.shape
    flat, flat_weight = depth.reshape(n, h * w), weight.reshape(n, h * w)
    agree_depth, agree_px = np.float32(agree_depth), np.float32(agree_px)
    columns, room = np.empty(w, np.int32), np.empty((9, w), np.float32)
    for y in range(h):
        m = _gather(depth[i, y], mask[y], columns, room[0])
        z, u, v, there, d, q = room[0, :m], room[1, :m], room[2, :m], room[3, :m], room[4, :m], room[5, :m]
        agree, total, amount = room[6, :m], room[7, :m], room[8, :m]
        for a in range(m):
            own = weight[i, y, columns[a]] + np.float32(1e-3)
            agree[a], total[a], amount[a] = 0.0, own / z[a], own
        for s in range(len(neighbors)):
            j = neighbors[s]
            if j < 0:
                break
            _meet(maps[s], columns[:m], z, y, u, v, there)
            _sample_row(flat[j], flat_weight[j], w, h, u, v, d, q)
            _agree_row(
                backs[s], columns[:m], y, u, v, there, d, q, agree_depth, agree_px, agree, total, amount
            )
        for a in range(m):
            count[y, columns[a]], fused[y, columns[a]] = np.uint8(agree[a]), amount[a] / total[a]


def check_view(
    i: int, neighbors: np.ndarray, depth: np.ndarray, weight: np.ndarray, mask: np.ndarray, relative: np.ndarray, k,
    agree_depth: float, agree_px: float, count: np.ndarray, fused: np.ndarray,
) -> None:  # fmt: skip
    """Count the neighbors that agree with each pixel of view i (forward-backward reprojection), and fuse their depth.

    Args:
        i: Row of the view in `depth`.
        neighbors: (k,) rows, -1 = none.
        depth: float32 (n, h, w).
        weight: float32 (n, h, w) of each pixel in the mean.
        mask: bool (h, w) pixels to ask about.
        relative: (k, 4, 4) neighbor_from_view.
        k: fx, fy, cx, cy.
        agree_depth: Relative depth difference allowed.
        agree_px: Reprojection error allowed.
        count: (h, w) uint8, written.
        fused: (h, w) float32, written.
    """
    maps, backs = _pixel_maps(relative, k), _pixel_maps(invert_rigid(relative), k)
    _check(i, neighbors, depth, weight, mask, maps, backs, agree_depth, agree_px, count, fused)


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=FAST, forceinline=True)
def _witness_row(
    depth, width, height, u, v, there, beyond, same, agree, through
):  # pragma: no cover - compiled
    """Add 1 to the counts of pixels (m,) that a view with `depth` (height * width,) sees, or looks through."""
    nil, one, w, h = np.float32(0.0), np.float32(1.0), np.float32(width), np.float32(height)
    last_u, last_v, stride = np.float32(width - 1), np.float32(height - 1), np.int32(width)
    for n in range(len(u)):
        seen = (u[n] >= nil) & (v[n] >= nil) & (u[n] < w) & (v[n] < h)
        x, y = np.int32(min(max(nil, u[n]), last_u)), np.int32(min(max(nil, v[n]), last_v))
        d = load_only_read(depth, np.uint32(y * stride + x))  # pyright: ignore[reportCallIssue]
        farther = seen & (d > beyond * there[n])
        store_apart(through, n, through[n] + (one if farther else nil))
        equal = seen & (abs(d - there[n]) < same * there[n])
        store_apart(agree, n, agree[n] + (one if equal else nil))


@numba.njit(cache=True, nogil=True)
def _witnesses(i, neighbors, depth, mask, maps, beyond, same, agree, through):  # pragma: no cover - compiled
    n, h, w = depth.shape
    flat, beyond, same = depth.reshape(n, h * w), np.float32(beyond), np.float32(same)
    columns, room = np.empty(w, np.int32), np.empty((6, w), np.float32)
    for y in range(h):
        m = _gather(depth[i, y], mask[y], columns, room[0])
        z, u, v, there = room[0, :m], room[1, :m], room[2, :m], room[3, :m]
        for_it, against = room[4, :m], room[5, :m]
        for_it[:] = 0.0
        against[:] = 0.0
        for s in range(len(neighbors)):
            j = neighbors[s]
            if j < 0:
                break
            _meet(maps[s], columns[:m], z, y, u, v, there)
            _witness_row(flat[j], w, h, u, v, there, beyond, same, for_it, against)
        for a in range(m):
            agree[y, columns[a]], through[y, columns[a]] = np.uint8(for_it[a]), np.uint8(against[a])


def count_witnesses(
    i: int, neighbors: np.ndarray, depth: np.ndarray, mask: np.ndarray, relative: np.ndarray, k, beyond: float,
    same: float, agree: np.ndarray, through: np.ndarray,
) -> None:  # fmt: skip
    """Count the neighbors that see the same point as each masked pixel of view i, and those that look through it.

    Args:
        i: Row of the view in `depth`.
        neighbors: (k,) rows, -1 = none.
        depth: float32 (n, h, w).
        mask: bool (h, w) pixels to ask about.
        relative: (k, 4, 4) neighbor_from_view.
        k: fx, fy, cx, cy.
        beyond: Ratio of depths from which on a neighbor looks through the point.
        same: Relative difference up to which it sees the same.
        agree: (h, w) uint8, written where asked.
        through: (h, w) uint8, written where asked.
    """
    _witnesses(i, neighbors, depth, mask, _pixel_maps(relative, k), beyond, same, agree, through)


def remove_speckles(depth: np.ndarray, min_px: int, jump: float) -> np.ndarray:
    """Return a mask (h, w) of pixels in connected pieces of at least `min_px`, cut where depth jumps by `jump`."""
    label = np.zeros(depth.shape, np.int32)
    sizes = label_pieces(depth, jump, label)
    return (depth > 0) & (sizes[label] >= min_px)


@numba.njit(cache=True, nogil=True)
def label_pieces(depth, jump, label):  # pragma: no cover - compiled
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
