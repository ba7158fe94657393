"""Occupancy grid by space carving: free where rays passed, surface where the mesh lies, unknown elsewhere."""

import math

import numba
import numpy as np

from reconstruction.core.types import SpaceGrid
from reconstruction.surface.pixels import FusionViews
from reconstruction.surface.tsdf import block_visible

_CHUNK = 8  # voxels a side of a chunk, the unit of parallel work
UNKNOWN, FREE, SURFACE = 0, 1, 2


@numba.njit(cache=True, parallel=True)
def _free(
    origin, voxel, poses, order, k, depth, carve, tiles, margin, completed_margin, min_rays, state
):  # pragma: no cover - compiled
    """Mark voxels that at least `min_rays` views see through. Chunks skip views that cannot see them."""
    n, h, w = depth.shape
    fx, fy, cx, cy = k
    sx, sy, sz = state.shape
    mx, my, mz = (sx + _CHUNK - 1) // _CHUNK, (sy + _CHUNK - 1) // _CHUNK, (sz + _CHUNK - 1) // _CHUNK
    radius = 0.5 * math.sqrt(3.0) * _CHUNK * voxel
    half = 0.5 * math.sqrt(3.0) * voxel
    for chunk in numba.prange(mx * my * mz):
        bx, by, bz = chunk // (my * mz), chunk // mz % my, chunk % mz
        x0, y0, z0 = bx * _CHUNK, by * _CHUNK, bz * _CHUNK
        x1, y1, z1 = min(sx, x0 + _CHUNK), min(sy, y0 + _CHUNK), min(sz, z0 + _CHUNK)
        center = np.empty(3)
        center[0] = origin[0] + (x0 + 0.5 * _CHUNK) * voxel
        center[1] = origin[1] + (y0 + 0.5 * _CHUNK) * voxel
        center[2] = origin[2] + (z0 + 0.5 * _CHUNK) * voxel
        votes = np.zeros((_CHUNK, _CHUNK, _CHUNK), np.uint8)
        left = (x1 - x0) * (y1 - y0) * (z1 - z0)
        for o in range(n):
            v = order[o]
            m = poses[v]
            if not block_visible(center, radius, m, k, (h, w), tiles[v]):
                continue
            for i in range(x0, x1):
                px = origin[0] + (i + 0.5) * voxel
                for j in range(y0, y1):
                    py = origin[1] + (j + 0.5) * voxel
                    for l in range(z0, z1):
                        if votes[i - x0, j - y0, l - z0] >= min_rays:
                            continue
                        pz = origin[2] + (l + 0.5) * voxel
                        z = m[2, 0] * px + m[2, 1] * py + m[2, 2] * pz + m[2, 3]
                        if z < 2.0 * voxel:
                            continue
                        pu = fx * (m[0, 0] * px + m[0, 1] * py + m[0, 2] * pz + m[0, 3]) / z + cx
                        pv = fy * (m[1, 0] * px + m[1, 1] * py + m[1, 2] * pz + m[1, 3]) / z + cy
                        if pu < 0.0 or pv < 0.0 or pu >= w or pv >= h:
                            continue
                        ix, iy = int(pu), int(pv)
                        kind = carve[v, iy, ix]
                        if kind == 0:
                            continue
                        # The whole voxel must lie before the surface, hence `half`.
                        if z + half + (margin if kind == 2 else completed_margin) < depth[v, iy, ix]:
                            votes[i - x0, j - y0, l - z0] += 1
                            if votes[i - x0, j - y0, l - z0] >= min_rays:
                                state[i, j, l] = FREE
                                left -= 1
            if left == 0:
                break


def carve_space(
    views: FusionViews, origin: np.ndarray, shape: tuple[int, int, int], voxel_size: float, *, margin: float,
    completed_margin: float, min_rays: int,
) -> SpaceGrid:  # fmt: skip
    """Carve free space by depth rays; `mark_surface` enters the surface afterwards.

    Args:
        views: of `prepare_views`, metres.
        origin: (3,) corner of the grid in world space.
        shape: number of voxels along x, y, z.
        voxel_size: metres.
        margin: distance before a measured depth that stays unknown, metres.
        completed_margin: the same for completed pixels.
        min_rays: a voxel is free if this many views see through it.
    """
    state = np.zeros(shape, np.uint8)
    # Views far apart in time first, so that chunks are finished after few views.
    n = len(views.depth)
    step = next(s for s in range(max(1, int(0.38 * n)), n + 2) if math.gcd(s, n) == 1)
    order = (np.arange(n) * step) % n
    _free(
        np.asarray(origin, np.float64), voxel_size, views.camera_from_world, order, views.camera.intrinsics,
        views.depth, views.carve, views.tile_max, margin, completed_margin, min_rays, state,
    )  # fmt: skip
    return SpaceGrid(np.asarray(origin, np.float64), float(voxel_size), state)


def mark_surface(space: SpaceGrid, vertices: np.ndarray, faces: np.ndarray) -> None:
    """Mark the voxels that a mesh (v, 3), (f, 3) crosses as surface, in place; wide faces are subdivided."""
    corners = vertices[faces]
    span = np.sqrt(((corners - np.roll(corners, 1, axis=1)) ** 2).sum(-1).max(1))
    points = [vertices]
    parts = 2 ** np.ceil(np.log2(np.maximum(span / (0.75 * space.voxel_size_m), 1.0))).astype(int)
    for count in np.unique(parts[parts > 1]):
        wide = corners[parts == count]
        for i in range(count + 1):
            for j in range(count + 1 - i):
                share = np.array([i, j, count - i - j], np.float32) / np.float32(count)
                points.append(np.einsum("k,nkd->nd", share, wide))
    for part in points:
        cell = np.floor((part - space.origin) / space.voxel_size_m).astype(np.int64)
        cell = cell[np.all((cell >= 0) & (cell < space.state.shape), axis=1)]
        space.state[tuple(cell.T)] = SURFACE
