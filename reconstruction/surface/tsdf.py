"""TSDF fusion (Curless and Levoy 1996) in sparse blocks of 8x8x8 voxels, allocated near the surface only.

Each voxel gathers from the views that see it. The loop over blocks is therefore parallel without races, and the result
does not depend on the number of threads. Distances are positive on the side of the camera, in units of the truncation.
Unobserved voxels have weight 0.
"""

import math
from dataclasses import dataclass

import numba
import numpy as np

from reconstruction.surface.pixels import TILE_PX, FusionViews

BLOCK = 8  # voxels a side of a block
_ONE_SURFACE = 0.02  # relative depth difference below which neighbouring pixels are on one surface
_IN_BAND = 0.5  # of the truncation: samples with smaller distances locate the surface
_RAY_WEIGHT = 0.05  # smallest weight of a free-space observation


@dataclass(frozen=True)
class BlockVolume:
    """A sparse TSDF: voxel (i, j, k) of block b has its centre at origin + (8 b + ijk + 0.5) voxel_size."""

    origin: np.ndarray  # float64 (3,) metres, world space
    voxel_size: float  # metres
    truncation: float  # metres
    blocks: np.ndarray  # int32 (m, 3) block coordinates
    distance: np.ndarray  # float32 (m, 8, 8, 8) in [-1, 1], in units of the truncation
    weight: np.ndarray  # float32 (m, 8, 8, 8) 0 = not observed
    views: np.ndarray  # uint8 (m, 8, 8, 8) number of views that saw surface near the voxel

    def joined(self, other: "BlockVolume") -> "BlockVolume":
        """Return this volume with the blocks of another one appended."""
        pairs = ((getattr(self, n), getattr(other, n)) for n in ("blocks", "distance", "weight", "views"))
        return BlockVolume(
            self.origin, self.voxel_size, self.truncation, *(np.concatenate(pair) for pair in pairs)
        )


@numba.njit(cache=True, parallel=True)
def _mark(
    depth, weight, world_from_camera, k, origin, block_size, truncation, stride, marks
):  # pragma: no cover
    """Mark the blocks that the truncation band of any pixel touches; all threads write the same value."""
    n, h, w = depth.shape
    fx, fy, cx, cy = k
    nx, ny, nz = marks.shape
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
                        marks[bx, by, bz] = True


@numba.njit(cache=True, inline="always")
def _bilinear(depth, here, pu, pv):  # pragma: no cover - compiled
    """Return depth at pixel coordinates: bilinear if the four neighbours are on one surface, else `here`."""
    h, w = depth.shape
    x, y = pu - 0.5, pv - 0.5
    x0, y0 = int(math.floor(x)), int(math.floor(y))
    if x0 < 0 or y0 < 0 or x0 + 1 >= w or y0 + 1 >= h:
        return here
    a, b, c, d = depth[y0, x0], depth[y0, x0 + 1], depth[y0 + 1, x0], depth[y0 + 1, x0 + 1]
    low = min(min(a, b), min(c, d))
    if low <= 0.0 or max(max(a, b), max(c, d)) - low >= _ONE_SURFACE * low:
        return here
    tx, ty = x - x0, y - y0
    return (a * (1.0 - tx) + b * tx) * (1.0 - ty) + (c * (1.0 - tx) + d * tx) * ty


@numba.njit(cache=True)
def block_visible(center, radius, m, k, shape, reach):  # pragma: no cover - compiled
    """Tell whether a view may see a ball: it meets the frustum and is not wholly behind the tiles' `reach`."""
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
    x0, x1 = max(0, int(u - r) // TILE_PX), min(reach.shape[1] - 1, int(u + r) // TILE_PX)
    y0, y1 = max(0, int(v - r) // TILE_PX), min(reach.shape[0] - 1, int(v + r) // TILE_PX)
    for ty in range(y0, y1 + 1):
        for tx in range(x0, x1 + 1):
            if reach[ty, tx] > z - radius:
                return True
    return False


@numba.njit(cache=True, parallel=True)
def _integrate(
    blocks, origin, edge, trunc, poses, k, depth, weight, slope, carve, reach, out_distance, out_weight, out_views
):  # fmt: skip  # pragma: no cover - compiled
    """Fuse all views into blocks. One kernel despite its length: the nested loops share their increments."""
    n, h, w = depth.shape
    side = out_distance.shape[1]
    voxel = edge / side
    fx, fy, cx, cy = k
    radius = 0.5 * math.sqrt(3.0) * edge
    share = 1.0 / trunc
    for b in numba.prange(blocks.shape[0]):
        corner = origin + blocks[b] * edge + 0.5 * voxel
        center = origin + (blocks[b] + 0.5) * edge
        # Accumulate sums of weight * distance and of weight in the outputs.
        total, amount, seen = out_distance[b], out_weight[b], out_views[b]
        for v in range(n):
            m = poses[v]
            if not block_visible(center, radius, m, k, (h, w), reach[v]):
                continue
            z_of, weight_of, slope_of, carve_of = depth[v], weight[v], slope[v], carve[v]
            # Along a row of voxels, depth and pixel times depth are affine.
            sz = m[2, 2] * voxel
            su, sv = (fx * m[0, 2] + cx * m[2, 2]) * voxel, (fy * m[1, 2] + cy * m[2, 2]) * voxel
            for i in range(side):
                px = corner[0] + i * voxel
                for j in range(side):
                    py = corner[1] + j * voxel
                    z0 = m[2, 0] * px + m[2, 1] * py + m[2, 2] * corner[2] + m[2, 3]
                    u0 = fx * (m[0, 0] * px + m[0, 1] * py + m[0, 2] * corner[2] + m[0, 3]) + cx * z0
                    v0 = fy * (m[1, 0] * px + m[1, 1] * py + m[1, 2] * corner[2] + m[1, 3]) + cy * z0
                    for l in range(side):
                        z = z0 + l * sz
                        if z <= trunc:
                            continue
                        inverse = 1.0 / z
                        pu, pv = (u0 + l * su) * inverse, (v0 + l * sv) * inverse
                        if pu < 0.0 or pv < 0.0 or pu >= w or pv >= h:
                            continue
                        ix, iy = int(pu), int(pv)
                        kind = carve_of[iy, ix]
                        if kind == 0:
                            continue
                        d = z_of[iy, ix]
                        cosine = slope_of[iy, ix] * (1.0 / 255.0)
                        s = (d - z) * cosine
                        # Interpolation changes depth by less than `span`: skip it far from the surface.
                        span = _ONE_SURFACE * d * cosine
                        if s < -trunc - span:
                            continue
                        if s <= trunc + span:
                            s = (_bilinear(z_of, d, pu, pv) - z) * cosine
                            if s < -trunc:
                                continue
                        q = weight_of[iy, ix]
                        if s > trunc:
                            # Free-space observation: distance +1.
                            if kind == 2:
                                q = max(q, np.float32(_RAY_WEIGHT))
                                total[i, j, l] += q
                                amount[i, j, l] += q
                            continue
                        if q <= 0.0:
                            continue
                        if s < 0.0:
                            # Weight fades behind the surface, so that both sides of thin objects survive.
                            q *= 1.0 + s * share
                        total[i, j, l] += q * s * share
                        amount[i, j, l] += q
                        if seen[i, j, l] < 255:
                            seen[i, j, l] += 1
        for i in range(side):
            for j in range(side):
                for l in range(side):
                    if amount[i, j, l] > 0.0:
                        total[i, j, l] /= amount[i, j, l]


@numba.njit(cache=True, parallel=True)
def _tile_reach(depth, weight, slope, trunc, reach):  # pragma: no cover - compiled
    """Fill per tile the depth beyond which no pixel observes anything: surface depth plus the truncation band."""
    n, h, w = depth.shape
    for v in numba.prange(n):
        for y in range(h):
            for x in range(w):
                if depth[v, y, x] > 0.0 and slope[v, y, x] > 0:
                    far = depth[v, y, x] + trunc * 255.0 / slope[v, y, x]
                    if far > reach[v, y // TILE_PX, x // TILE_PX]:
                        reach[v, y // TILE_PX, x // TILE_PX] = far


@numba.njit(cache=True)
def _solve(a, r):  # pragma: no cover - compiled
    """Solve a symmetric positive definite 4x4 system in place; calling LAPACK would take seconds to compile."""
    for p in range(4):
        for q in range(p + 1, 4):
            f = a[q, p] / a[p, p]
            for c in range(p, 4):
                a[q, c] -= f * a[p, c]
            r[q] -= f * r[p]
    for p in range(3, -1, -1):
        for c in range(p + 1, 4):
            r[p] -= a[p, c] * r[c]
        r[p] /= a[p, p]


@numba.njit(cache=True, parallel=True)
def _fit_blocks(distance, weight, out_fit, out_error):  # pragma: no cover - compiled
    """Fit distance = g . x + c to the in-band samples of each block, x in samples from the block's centre.

    out_fit is (g, c), out_error the largest deviation, -1 for blocks with too few samples.
    """
    side = distance.shape[1]
    half = 0.5 * (side - 1)
    for b in numba.prange(distance.shape[0]):
        a, r, x = np.zeros((4, 4)), np.zeros(4), np.ones(4)
        count = 0
        for i in range(side):
            for j in range(side):
                for l in range(side):
                    d = distance[b, i, j, l]
                    if weight[b, i, j, l] <= 0.0 or abs(d) > _IN_BAND:
                        continue
                    count += 1
                    x[0], x[1], x[2] = i - half, j - half, l - half
                    for p in range(4):
                        r[p] += x[p] * d
                        for q in range(4):
                            a[p, q] += x[p] * x[q]
        out_error[b] = -1.0
        if count < side * side // 2:
            continue
        for p in range(4):
            a[p, p] += 1e-3
        _solve(a, r)
        fit = r
        worst = 0.0
        for i in range(side):
            for j in range(side):
                for l in range(side):
                    d = distance[b, i, j, l]
                    if weight[b, i, j, l] <= 0.0:
                        continue
                    e = fit[0] * (i - half) + fit[1] * (j - half) + fit[2] * (l - half) + fit[3]
                    # Outside of the band only the sign counts.
                    worst = max(
                        worst, abs(min(_IN_BAND, max(-_IN_BAND, e)) - min(_IN_BAND, max(-_IN_BAND, d)))
                    )
        out_error[b] = worst
        for p in range(4):
            out_fit[b, p] = fit[p]


@numba.njit(cache=True, parallel=True)
def _pixel_sizes(blocks, origin, edge, poses, k, shape, reach, out):  # pragma: no cover - compiled
    """Fill per block the smallest pixel footprint among the views that may see it; infinite if none does."""
    radius = 0.5 * math.sqrt(3.0) * edge
    for b in numba.prange(blocks.shape[0]):
        center = origin + (blocks[b] + 0.5) * edge
        nearest = np.inf
        for v in range(poses.shape[0]):
            m = poses[v]
            z = m[2, 0] * center[0] + m[2, 1] * center[1] + m[2, 2] * center[2] + m[2, 3]
            if 0.0 < z < nearest and block_visible(center, radius, m, k, shape, reach[v]):
                nearest = z
        out[b] = nearest / k[0]


@numba.njit(cache=True, inline="always")
def _trilinear(d, w, x, y, z):  # pragma: no cover - compiled
    """Interpolate samples (s, s, s) trilinearly, also slightly outside; the nearest one if any of eight is missing."""
    top = d.shape[0] - 2
    i, j, l = min(max(int(x), 0), top), min(max(int(y), 0), top), min(max(int(z), 0), top)
    u, v, t = x - i, y - j, z - l
    total = 0.0
    for c in range(8):
        a, b, e = c & 1, c >> 1 & 1, c >> 2 & 1
        if w[i + a, j + b, l + e] <= 0.0:
            return np.float64(d[int(x + 0.5), int(y + 0.5), int(z + 0.5)])
        total += (
            (u if a else 1.0 - u) * (v if b else 1.0 - v) * (t if e else 1.0 - t) * d[i + a, j + b, l + e]
        )
    return total


@numba.njit(cache=True, parallel=True)
def _spread(
    rows, flat, fit, distance, weight, views, out_distance, out_weight, out_views
):  # pragma: no cover - compiled
    """Upsample coarse blocks to all voxels: from the fitted plane of flat blocks, else by interpolation."""
    side, coarse = out_distance.shape[1], weight.shape[1]
    ratio = side // coarse
    half = 0.5 * (coarse - 1)
    for n in numba.prange(len(rows)):
        b = rows[n]
        for i in range(side):
            x = (i + 0.5) / ratio - 0.5
            for j in range(side):
                y = (j + 0.5) / ratio - 0.5
                for l in range(side):
                    z = (l + 0.5) / ratio - 0.5
                    if flat[b]:
                        d = (
                            fit[b, 0] * (x - half) + fit[b, 1] * (y - half) + fit[b, 2] * (z - half) + fit[b, 3]
                        )  # fmt: skip
                    else:
                        d = _trilinear(distance[b], weight[b], x, y, z)
                    out_distance[b, i, j, l] = min(1.0, max(-1.0, d))
                    out_weight[b, i, j, l] = weight[b, i // ratio, j // ratio, l // ratio]
                    out_views[b, i, j, l] = views[b, i // ratio, j // ratio, l // ratio]


def surface_blocks(
    views: FusionViews, world_from_camera: np.ndarray, origin: np.ndarray, shape: tuple[int, int, int],
    voxel_size: float, truncation: float,
) -> np.ndarray:  # fmt: skip
    """Return the blocks, int32 (m, 3), that the truncation band of any view touches, in a grid of `shape` blocks."""
    marks = np.zeros(shape, bool)
    # Every second pixel suffices for blocks of eight voxels.
    _mark(
        views.depth, views.weight, np.ascontiguousarray(world_from_camera), views.camera.intrinsics, origin,
        BLOCK * voxel_size, truncation, 2, marks,
    )  # fmt: skip
    return np.argwhere(marks).astype(np.int32)


def tile_reach(views: FusionViews, truncation: float) -> np.ndarray:
    """Return per view and tile, float32 (n, th, tw), the depth beyond which no pixel observes anything."""
    reach = np.zeros(views.tile_max.shape, np.float32)
    _tile_reach(views.depth, views.weight, views.slope, truncation, reach)
    return reach


def _sampled(
    views: FusionViews, reach: np.ndarray, blocks: np.ndarray, origin: np.ndarray, edge: float, truncation: float,
    side: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """Return distance, weight and views (m, side, side, side) of blocks sampled at `side` voxels a side."""
    distance, weight, seen = _empty_volume(len(blocks), side)
    _integrate(
        blocks, origin, edge, truncation, views.camera_from_world, views.camera.intrinsics, views.depth, views.weight,
        views.slope, views.carve, reach, distance, weight, seen,
    )  # fmt: skip
    return distance, weight, seen


def _empty_volume(blocks: int, side: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    cells = (blocks, side, side, side)
    return np.zeros(cells, np.float32), np.zeros(cells, np.float32), np.zeros(cells, np.uint8)


def integrate(
    views: FusionViews, reach: np.ndarray, blocks: np.ndarray, origin: np.ndarray, voxel_size: float,
    truncation: float, flat_error: float,
) -> BlockVolume:  # fmt: skip
    """Fuse all views into the given blocks.

    Blocks are first sampled at every second voxel. That suffices if the samples are planar within `flat_error`, if no
    surface is near, or if all pixel footprints exceed a voxel. The other blocks (a third in rooms) are sampled at every
    voxel.

    Args:
        views: of `prepare_views`.
        reach: of `tile_reach`.
        blocks: int32 (m, 3).
        origin: (3,) of block (0, 0, 0), world space, metres.
        voxel_size: metres.
        truncation: metres.
        flat_error: metres.
    """
    origin, edge = np.asarray(origin, np.float64), BLOCK * voxel_size
    coarse, weight, seen = _sampled(views, reach, blocks, origin, edge, truncation, BLOCK // 2)
    fit, error, pixel = np.zeros((len(blocks), 4)), np.zeros(len(blocks)), np.zeros(len(blocks))
    _fit_blocks(coarse, weight, fit, error)
    shape = views.depth.shape[1:]
    _pixel_sizes(blocks, origin, edge, views.camera_from_world, views.camera.intrinsics, shape, reach, pixel)
    flat = (error >= 0) & (error * truncation <= flat_error)
    # Voxels of an edge that the surface crosses are within one voxel of it: farther off only the sign counts.
    away = ~((weight > 0) & (np.abs(coarse) < 1.4 * voxel_size / truncation)).any(axis=(1, 2, 3))
    simple = flat | away | (pixel > voxel_size)
    out = _empty_volume(len(blocks), BLOCK)
    _spread(np.flatnonzero(simple), flat, fit, coarse, weight, seen, *out)
    rough = np.flatnonzero(~simple)
    for into, fine in zip(out, _sampled(views, reach, blocks[rough], origin, edge, truncation, BLOCK)):
        into[rough] = fine
    return BlockVolume(origin, voxel_size, truncation, blocks, *out)
