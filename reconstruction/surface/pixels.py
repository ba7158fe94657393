"""Per-pixel inputs of TSDF fusion: weight, slope of the surface, and permission to carve free space."""

import math
from dataclasses import dataclass

import numba
import numpy as np

from reconstruction.core.types import Camera, DepthMaps
from registry.geometry import invert_rigid

TILE_PX = 8  # pixels a side of a tile, for visibility tests


@dataclass(frozen=True)
class FusionViews:
    """Depth maps prepared for the fusion kernels; metres, world space."""

    camera: Camera
    camera_from_world: np.ndarray  # float64 (n, 4, 4) rigid
    depth: np.ndarray  # float32 (n, h, w) z-depth, 0 = unknown
    weight: np.ndarray  # float32 (n, h, w) 0 = makes no surface
    slope: np.ndarray  # uint8 (n, h, w) 255 * factor from a distance along z to one along the surface normal
    carve: np.ndarray  # uint8 (n, h, w) 0 the ray carves nothing, 1 completed pixel, 2 measured pixel
    tile_max: np.ndarray  # float32 (n, th, tw) largest depth in each tile of TILE_PX x TILE_PX pixels
    color: np.ndarray  # uint8 (n, h, w, 3) RGB


@numba.njit(cache=True)
def _derivative(depth, y, x, dy, dx, jump):  # pragma: no cover - compiled
    """Return the change of inverse depth per pixel along (dy, dx), and the state of the two neighbours."""
    h, w = depth.shape
    z = depth[y, x]
    total, span = 0.0, 0
    before, after = 0, 0  # 0 continuous, +1 farther, -1 nearer, 2 unknown
    for side in (-1, 1):
        state = 2
        for reach in (1, 2):
            yy, xx = y + side * reach * dy, x + side * reach * dx
            if yy < 0 or yy >= h or xx < 0 or xx >= w or depth[yy, xx] <= 0.0:
                break
            step = depth[yy, xx] / z - 1.0
            if abs(step) > jump * reach:
                if reach == 1:
                    state = 1 if step > 0 else -1
                break
            state = 0
            if reach == 2:
                total += side * (1.0 / depth[yy, xx] - 1.0 / z)
                span += 2
        if side < 0:
            before = state
        else:
            after = state
    return (total / span if span > 0 else 0.0), before, after


@numba.njit(cache=True, parallel=True)
def _weigh(
    depth, confidence, k, reference, max_depth, completed_weight, weight, slope, carve
):  # pragma: no cover
    """Fill weight, slope and carve (n, h, w) of every known pixel; flying pixels keep zeros."""
    n, h, w = depth.shape
    fx, fy, cx, cy = k
    for row in numba.prange(n * h):
        v, y = row // h, row % h
        for x in range(w):
            z = depth[v, y, x]
            c = confidence[v, y, x]
            if z <= 0.0 or c == 0:
                continue
            gx, left, right = _derivative(depth[v], y, x, 0, 1, 0.03)
            gy, up, down = _derivative(depth[v], y, x, 1, 0, 0.03)
            # Flying pixel: between a nearer and a farther neighbour, on neither surface.
            if left * right == -1 or up * down == -1:
                continue
            carve[v, y, x] = 2 if c == 2 else 1
            xn, yn = (x + 0.5 - cx) / fx, (y + 0.5 - cy) / fy
            a, b = gx * fx, gy * fy
            inverse = 1.0 / z
            cc = inverse - a * xn - b * yn
            s = inverse / math.sqrt(a * a + b * b + cc * cc)
            cosine = s / math.sqrt(xn * xn + yn * yn + 1.0)
            slope[v, y, x] = np.uint8(min(255.0, max(64.0, s * 255.0)))
            if z > max_depth:
                continue
            q = max(cosine, 0.15)
            q *= min(1.0, (reference / z) ** 2)
            if left != 0 or right != 0 or up != 0 or down != 0:
                q *= 0.3
            weight[v, y, x] = q if c == 2 else q * completed_weight


@numba.njit(cache=True, parallel=True)
def _tile_maximum(depth, tiles):  # pragma: no cover - compiled
    n, h, w = depth.shape
    for v in numba.prange(n):
        for y in range(h):
            for x in range(w):
                t = depth[v, y, x]
                if t > tiles[v, y // TILE_PX, x // TILE_PX]:
                    tiles[v, y // TILE_PX, x // TILE_PX] = t


def prepare_views(
    depth: DepthMaps,
    world_from_camera: np.ndarray,
    images: np.ndarray,
    *,
    reference_depth: float,
    max_depth: float,
    completed_weight: float,
) -> FusionViews:
    """Compute the fusion inputs of every pixel.

    Args:
        depth: depth maps, metres.
        world_from_camera: (n, 4, 4) rigid.
        images: uint8 (n, H, W, 3) RGB; resampled to depth resolution.
        reference_depth: as `SurfaceConfig.reference_depth_m`.
        max_depth: pixels beyond it get weight 0, metres.
        completed_weight: factor on the weight of completed pixels.
    """
    import cv2

    d = np.ascontiguousarray(depth.depth, np.float32)
    n, h, w = d.shape
    weight, slope = np.zeros((n, h, w), np.float32), np.zeros((n, h, w), np.uint8)
    carve = np.zeros((n, h, w), np.uint8)
    confidence, k = np.ascontiguousarray(depth.confidence), depth.camera.intrinsics
    _weigh(d, confidence, k, reference_depth, max_depth, completed_weight, weight, slope, carve)
    tiles = np.zeros((n, -(-h // TILE_PX), -(-w // TILE_PX)), np.float32)
    _tile_maximum(d, tiles)
    color = np.empty((n, h, w, 3), np.uint8)
    for i in range(n):
        same = images[i].shape[:2] == (h, w)
        color[i] = images[i] if same else cv2.resize(images[i], (w, h), interpolation=cv2.INTER_AREA)
    camera_from_world = np.ascontiguousarray(invert_rigid(world_from_camera))
    return FusionViews(depth.camera, camera_from_world, d, weight, slope, carve, tiles, color)
