"""Truncated signed distances in 8x8x8 blocks of voxels, allocated only near the surface.

Every voxel gathers from the views that see it, so that the loop over blocks is parallel without races and the
result does not depend on the number of threads. Distances are positive on the side of the camera, in units of the
truncation; a voxel that no view observed has weight 0.
"""

import math
from dataclasses import dataclass

import numba
import numpy as np

from reconstruction.surface.pixels import TILE_PX, FusionViews

BLOCK = 8


@dataclass(frozen=True)
class BlockVolume:
    """A sparse volume: voxel (i, j, k) of block b has its centre at origin + (8 b + ijk + 0.5) voxel_size."""

    origin: np.ndarray  # float64 (3,)
    voxel_size: float
    truncation: float
    blocks: np.ndarray  # int32 (m, 3)
    index: np.ndarray  # int32 (bx, by, bz) row of `blocks`, -1 = none
    distance: np.ndarray  # float32 (m, 8, 8, 8) in [-1, 1], in units of the truncation
    weight: np.ndarray  # float32 (m, 8, 8, 8)
    views: np.ndarray  # uint8 (m, 8, 8, 8) how many views saw the surface near the voxel
    free_views: np.ndarray  # uint8 (m, 8, 8, 8) how many views measured something behind the voxel
    color: np.ndarray  # uint8 (m, 8, 8, 8, 3)


@numba.njit(cache=True, parallel=True)
def _mark(
    depth, weight, world_from_camera, k, origin, block_size, truncation, stride, marks
):  # pragma: no cover
    """Set marks[view, bx, by, bz] for every block that a view's surface band touches."""
    n, h, w = depth.shape
    fx, fy, cx, cy = k
    nx, ny, nz = marks.shape[1:]
    for v in numba.prange(n):
        m = world_from_camera[v]
        for y in range(0, h, stride):
            for x in range(0, w, stride):
                if weight[v, y, x] <= 0.0:
                    continue
                xn, yn = (x + 0.5 - cx) / fx, (y + 0.5 - cy) / fy
                length = math.sqrt(xn * xn + yn * yn + 1.0)
                for s in range(-1, 2):
                    z = depth[v, y, x] + s * truncation / length
                    px = m[0, 0] * xn * z + m[0, 1] * yn * z + m[0, 2] * z + m[0, 3]
                    py = m[1, 0] * xn * z + m[1, 1] * yn * z + m[1, 2] * z + m[1, 3]
                    pz = m[2, 0] * xn * z + m[2, 1] * yn * z + m[2, 2] * z + m[2, 3]
                    bx = int(math.floor((px - origin[0]) / block_size))
                    by = int(math.floor((py - origin[1]) / block_size))
                    bz = int(math.floor((pz - origin[2]) / block_size))
                    if 0 <= bx < nx and 0 <= by < ny and 0 <= bz < nz:
                        marks[v, bx, by, bz] = True


@numba.njit(cache=True)
def _nearest_or_bilinear(depth, u, v, tolerance):  # pragma: no cover - compiled
    """Sample depth at pixel coordinates: bilinear where the four neighbours are one surface."""
    h, w = depth.shape
    x, y = u - 0.5, v - 0.5
    x0, y0 = int(math.floor(x)), int(math.floor(y))
    if 0 <= x0 < w - 1 and 0 <= y0 < h - 1:
        a, b, c, d = depth[y0, x0], depth[y0, x0 + 1], depth[y0 + 1, x0], depth[y0 + 1, x0 + 1]
        low = min(min(a, b), min(c, d))
        if low > 0.0 and max(max(a, b), max(c, d)) - low < tolerance * low:
            fx, fy = x - x0, y - y0
            return (a * (1 - fx) + b * fx) * (1 - fy) + (c * (1 - fx) + d * fx) * fy
    return depth[int(v), int(u)]


@numba.njit(cache=True)
def _block_visible(center, radius, m, k, shape, tiles, slack):  # pragma: no cover - compiled
    """Tell whether a view may see a ball: in the frustum, and not wholly behind all depth there."""
    h, w = shape
    fx, fy, cx, cy = k
    z = m[2, 0] * center[0] + m[2, 1] * center[1] + m[2, 2] * center[2] + m[2, 3]
    if z <= radius * 1.5:
        return z > -radius
    x = m[0, 0] * center[0] + m[0, 1] * center[1] + m[0, 2] * center[2] + m[0, 3]
    y = m[1, 0] * center[0] + m[1, 1] * center[1] + m[1, 2] * center[2] + m[1, 3]
    u, v, r = fx * x / z + cx, fy * y / z + cy, max(fx, fy) * radius / (z - radius)
    if u + r < 0 or u - r >= w or v + r < 0 or v - r >= h:
        return False
    x0, x1 = max(0, int(u - r) // TILE_PX), min(tiles.shape[1] - 1, int(u + r) // TILE_PX)
    y0, y1 = max(0, int(v - r) // TILE_PX), min(tiles.shape[0] - 1, int(v + r) // TILE_PX)
    for ty in range(y0, y1 + 1):
        for tx in range(x0, x1 + 1):
            if tiles[ty, tx] + slack > z - radius:
                return True
    return False


@numba.njit(cache=True, parallel=True)
def _integrate(
    blocks, origin, voxel, trunc, poses, k, depth, weight, slope, carve, tiles, color, mask, use_mask,
    out_distance, out_weight, out_views, out_free, out_color,
):  # pragma: no cover - compiled  # fmt: skip
    n, h, w = depth.shape
    fx, fy, cx, cy = k
    radius = 0.5 * math.sqrt(3.0) * BLOCK * voxel
    for b in numba.prange(blocks.shape[0]):
        corner = origin + blocks[b] * (BLOCK * voxel) + 0.5 * voxel
        center = corner + 0.5 * (BLOCK - 1) * voxel
        total = np.zeros((BLOCK, BLOCK, BLOCK, 6), np.float32)  # sum of w*d, w, wc, wc*r, wc*g, wc*b
        for v in range(n):
            m = poses[v]
            if not _block_visible(center, radius, m, k, (h, w), tiles[v], 4.0 * trunc):
                continue
            for i in range(BLOCK):
                px = corner[0] + i * voxel
                for j in range(BLOCK):
                    py = corner[1] + j * voxel
                    ax = m[0, 0] * px + m[0, 1] * py + m[0, 3]
                    ay = m[1, 0] * px + m[1, 1] * py + m[1, 3]
                    az = m[2, 0] * px + m[2, 1] * py + m[2, 3]
                    for l in range(BLOCK):
                        pz = corner[2] + l * voxel
                        z = az + m[2, 2] * pz
                        if z <= trunc:
                            continue
                        pu = fx * (ax + m[0, 2] * pz) / z + cx
                        pv = fy * (ay + m[1, 2] * pz) / z + cy
                        if pu < 0.0 or pv < 0.0 or pu >= w or pv >= h:
                            continue
                        ix, iy = int(pu), int(pv)
                        kind = carve[v, iy, ix]
                        if kind == 0:
                            continue
                        d = _nearest_or_bilinear(depth[v], pu, pv, 0.02)
                        s = (d - z) * slope[v, iy, ix] / 255.0
                        if s < -trunc:
                            continue
                        q = weight[v, iy, ix]
                        own = not use_mask or mask[v, iy, ix]
                        if s > trunc or not own:
                            # Space that a ray crossed; pixels of other things tell only that it is free.
                            if kind != 2 or s < (trunc if own else voxel):
                                continue
                            if out_free[b, i, j, l] < 255:
                                out_free[b, i, j, l] += 1
                            q = max(q, np.float32(0.05))
                            total[i, j, l, 0] += q * min(s / trunc, 1.0)
                            total[i, j, l, 1] += q
                            continue
                        if q <= 0.0:
                            continue
                        if s < 0.0:
                            # Behind a surface nothing is measured: trust fades, so that thin things keep two sides.
                            q *= 1.0 + s / trunc
                        elif kind == 2 and s > 1.5 * voxel and out_free[b, i, j, l] < 255:
                            out_free[b, i, j, l] += 1
                        total[i, j, l, 0] += q * s / trunc
                        total[i, j, l, 1] += q
                        if out_views[b, i, j, l] < 255:
                            out_views[b, i, j, l] += 1
                        near = q * (1.0 - min(1.0, abs(s) / trunc)) + np.float32(1e-6)
                        total[i, j, l, 2] += near
                        for c in range(3):
                            total[i, j, l, 3 + c] += near * color[v, iy, ix, c]
        for i in range(BLOCK):
            for j in range(BLOCK):
                for l in range(BLOCK):
                    q = total[i, j, l, 1]
                    out_weight[b, i, j, l] = q
                    if q > 0.0:
                        out_distance[b, i, j, l] = total[i, j, l, 0] / q
                    near = total[i, j, l, 2]
                    if near > 0.0:
                        for c in range(3):
                            out_color[b, i, j, l, c] = np.uint8(total[i, j, l, 3 + c] / near + 0.5)


def surface_blocks(
    views: FusionViews, world_from_camera: np.ndarray, origin: np.ndarray, shape: tuple[int, int, int],
    voxel_size: float, truncation: float,
) -> np.ndarray:  # fmt: skip
    """Return the blocks (m, 3) that the surface bands of at least one view touch, in a grid of `shape` blocks."""
    counts = np.zeros(shape, bool)
    # A few views at a time bound the memory; every second pixel is enough for blocks of eight voxels.
    for start in range(0, len(views.depth), 16):
        part = slice(start, start + 16)
        marks = np.zeros((len(views.depth[part]), *shape), bool)
        _mark(
            views.depth[part], views.weight[part], np.ascontiguousarray(world_from_camera[part]), views.intrinsics,
            origin, BLOCK * voxel_size, truncation, 2, marks,
        )  # fmt: skip
        counts |= marks.any(0)
    return np.argwhere(counts).astype(np.int32)


def integrate(
    views: FusionViews, blocks: np.ndarray, shape: tuple[int, int, int], origin: np.ndarray, voxel_size: float,
    truncation: float, mask: np.ndarray | None = None,
) -> BlockVolume:  # fmt: skip
    """Fuse all views into the given blocks. `mask` (n, h, w) restricts which pixels may make surface."""
    m = len(blocks)
    cells = (m, BLOCK, BLOCK, BLOCK)
    distance, weight = np.zeros(cells, np.float32), np.zeros(cells, np.float32)
    seen, free = np.zeros(cells, np.uint8), np.zeros(cells, np.uint8)
    color = np.zeros((*cells, 3), np.uint8)
    used = np.zeros((1, 1, 1), bool) if mask is None else np.ascontiguousarray(mask, bool)
    _integrate(
        blocks, np.asarray(origin, np.float64), voxel_size, truncation, views.camera_from_world, views.intrinsics,
        views.depth, views.weight, views.slope, views.carve, views.tile_max, views.color, used, mask is not None,
        distance, weight, seen, free, color,
    )  # fmt: skip
    index = np.full(shape, -1, np.int32)
    index[tuple(blocks.T)] = np.arange(m, dtype=np.int32)
    return BlockVolume(
        np.asarray(origin, np.float64),
        voxel_size,
        truncation,
        blocks,
        index,
        distance,
        weight,
        seen,
        free,
        color,
    )
