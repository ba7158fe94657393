"""What the frames know of each pixel beside its depth: how squarely it was seen, and how noisy depth is at all.

Prepared once per scene and shared by all objects.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from reconstruction.core.types import DepthMaps, PosedFrames
from registry.geometry import invert_rigid, transform_points

_OUTLINE_PX = 3  # so far inside its outline a thing's pixels are surely its own


@dataclass(frozen=True)
class ScenePixels:
    """Depth pixels of all frames with instance ids and viewing angles."""

    depth: np.ndarray  # float32 (n, h, w) z-depth, 0 = unknown
    confidence: np.ndarray  # uint8 (n, h, w)
    ids: np.ndarray  # uint16 (n, h, w)
    cosine: np.ndarray  # float32 (n, h, w) of the angle between ray and surface normal; 0 at depth edges
    inner: np.ndarray  # bool (n, h, w) the pixels around show the same thing: depth and ids err at outlines
    noise_relative: float  # 1-sigma of depth over depth


def prepare_pixels(posed: PosedFrames, depth: DepthMaps, id_maps: np.ndarray) -> ScenePixels:
    """Compute viewing angles and the depth noise of a scene."""
    from reconstruction.assets.kernels import incidence_cosines

    maps = np.ascontiguousarray(depth.depth, np.float32)
    camera = depth.camera
    cosine = incidence_cosines(maps, camera.fx, camera.fy, camera.cx, camera.cy)
    ids = np.ascontiguousarray(id_maps, np.uint16)
    return ScenePixels(
        maps,
        np.ascontiguousarray(depth.confidence, np.uint8),
        ids,
        cosine,
        inner_pixels(ids),
        measure_noise(posed, depth),
    )


def inner_pixels(ids: np.ndarray) -> np.ndarray:
    """Tell which pixels (n, h, w) of id images have the same id all around, `_OUTLINE_PX` pixels far."""
    kernel = np.ones((2 * _OUTLINE_PX + 1,) * 2, np.uint8)
    return np.stack([cv2.erode(image, kernel) == cv2.dilate(image, kernel) for image in ids])


def measure_noise(posed: PosedFrames, depth: DepthMaps) -> float:
    """Return the relative 1-sigma of depth from how well neighbouring frames agree, within [0.0005, 0.02].

    Pixels of one frame are moved into the next one; differences above 4 % are occlusions, not noise.
    """
    camera, maps = depth.camera, depth.depth
    differences = []
    step = max(1, (camera.width * camera.height) // 1500)
    for a in range(0, len(maps) - 2, 2):
        b = a + 2
        flat = np.flatnonzero(np.asarray(maps[a]).ravel() > 0)[::step]
        v, u = np.divmod(flat, camera.width)
        z = maps[a][v, u].astype(np.float64)
        local = np.stack(
            [(u + 0.5 - camera.cx) / camera.fx * z, (v + 0.5 - camera.cy) / camera.fy * z, z], -1
        )
        world = transform_points(posed.world_from_camera[a], local)
        seen = transform_points(invert_rigid(posed.world_from_camera[b]), world)
        front = seen[:, 2] > 0.05
        seen = seen[front]
        u2 = np.floor(camera.fx * seen[:, 0] / seen[:, 2] + camera.cx).astype(int)
        v2 = np.floor(camera.fy * seen[:, 1] / seen[:, 2] + camera.cy).astype(int)
        inside = (u2 >= 0) & (v2 >= 0) & (u2 < camera.width) & (v2 < camera.height)
        there = maps[b][v2[inside], u2[inside]].astype(np.float64)
        relative = (there - seen[inside, 2]) / seen[inside, 2]
        differences.append(relative[(there > 0) & (np.abs(relative) < 0.04)])
    if not differences or sum(map(len, differences)) < 100:
        return 0.01
    # The 80 % quantile rather than the median: errors have heavy tails, most of all on small things.
    sigma = np.percentile(np.abs(np.concatenate(differences)), 80) / 1.2816 / np.sqrt(2.0)
    return float(np.clip(sigma, 0.0005, 0.02))


def object_noise(
    posed: PosedFrames, depth: DepthMaps, pixels: ScenePixels, seen: "SeenPoints", target: int
) -> float:
    """Return the relative 1-sigma of depth on one object: small things are seen worse than the room as a whole."""
    camera = depth.camera
    frames = np.unique(seen.frames)
    thin = slice(None, None, max(1, len(seen.points) // 6000))
    points, rows = seen.points[thin], np.searchsorted(frames, seen.frames[thin])
    differences = []
    for step in (-5, -3, 3, 5):
        other = rows + step
        valid = (other >= 0) & (other < len(frames))
        f = frames[other[valid]]
        local = np.einsum("nij,nj->ni", invert_rigid(posed.world_from_camera[f])[:, :3, :3], points[valid])
        local += invert_rigid(posed.world_from_camera[f])[:, :3, 3]
        z = np.maximum(local[:, 2], 1e-3)
        u = np.floor(camera.fx * local[:, 0] / z + camera.cx).astype(int)
        v = np.floor(camera.fy * local[:, 1] / z + camera.cy).astype(int)
        inside = (local[:, 2] > 0.05) & (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
        f, u, v, z = f[inside], u[inside], v[inside], z[inside]
        there = pixels.depth[f, v, u].astype(np.float64)
        same = (pixels.ids[f, v, u] == target) & (there > 0) & (pixels.cosine[f, v, u] > 0)
        relative = (there[same] - z[same]) / z[same]
        differences.append(relative[np.abs(relative) < 0.04])
    every = np.abs(np.concatenate(differences))
    if len(every) < 100:
        return max(pixels.noise_relative, 0.003)
    sigma = np.percentile(every, 68) / np.sqrt(2.0)
    return float(np.clip(sigma, pixels.noise_relative, 0.012))


@dataclass(frozen=True)
class SeenPoints:
    """Depth pixels of one object, lifted."""

    points: np.ndarray  # float64 (k, 3) world
    normals: np.ndarray  # float64 (k, 3) world, towards the camera; zero where unknown
    frames: np.ndarray  # int32 (k,) frame row
    pixel_m: np.ndarray  # float64 (k,) size of a pixel at the point


def lift_object(
    posed: PosedFrames, depth: DepthMaps, pixels: ScenePixels, target: int, limit: int = 60_000
) -> SeenPoints:
    """Lift the depth pixels of instance `target`, evenly thinned to about `limit` points, with normals."""
    camera = depth.camera
    rows, v, u = np.nonzero((pixels.ids == target) & (pixels.depth > 0))
    if len(rows) > limit:
        keep = np.linspace(0, len(rows) - 1, limit).astype(np.int64)
        rows, v, u = rows[keep], v[keep], u[keep]
    z = pixels.depth[rows, v, u].astype(np.float64)
    scale_x, scale_y = 1.0 / camera.fx, 1.0 / camera.fy
    local = np.stack([(u + 0.5 - camera.cx) * scale_x * z, (v + 0.5 - camera.cy) * scale_y * z, z], -1)
    normal = _pixel_normals(pixels, camera, rows, v, u)
    rotation = posed.world_from_camera[rows][:, :3, :3]
    points = np.einsum("nij,nj->ni", rotation, local) + posed.world_from_camera[rows][:, :3, 3]
    return SeenPoints(points, np.einsum("nij,nj->ni", rotation, normal), rows.astype(np.int32), z * scale_x)


def within_outlines(
    seen: SeenPoints, posed: PosedFrames, depth: DepthMaps, pixels: ScenePixels, target: int, votes: int = 20
) -> SeenPoints:
    """Drop points that frames see past: they project beside the object's outline and nothing there hides them.

    Outlines follow the picture's edges, depth does not: what it says beyond them are skirts.
    """
    camera = depth.camera
    shown = np.flatnonzero((pixels.ids == target).reshape(len(pixels.ids), -1).sum(axis=1) > 8)
    if len(seen.points) == 0 or len(shown) < 4:
        return seen
    shown = shown[np.unique(np.linspace(0, len(shown) - 1, votes).round().astype(int))]
    inside, outside = np.zeros(len(seen.points), np.int32), np.zeros(len(seen.points), np.int32)
    for f in shown:
        local = transform_points(invert_rigid(posed.world_from_camera[f]), seen.points)
        z = np.maximum(local[:, 2], 1e-3)
        u = np.floor(camera.fx * local[:, 0] / z + camera.cx).astype(int)
        v = np.floor(camera.fy * local[:, 1] / z + camera.cy).astype(int)
        valid = (local[:, 2] > 0.05) & (u >= 1) & (v >= 1) & (u < camera.width - 1) & (v < camera.height - 1)
        row = np.flatnonzero(valid)
        u, v, z = u[valid], v[valid], z[valid]
        own = pixels.ids[f] == target
        beside = own.copy()
        beside[1:] |= own[:-1]
        beside[:-1] |= own[1:]
        beside[:, 1:] |= own[:, :-1]
        beside[:, :-1] |= own[:, 1:]
        there = pixels.depth[f, v, u]
        agrees = own[v, u] & (np.abs(there - z) < 0.015 * z)
        passed = ~beside[v, u] & (there > z) & (pixels.cosine[f, v, u] > 0)
        inside[row[agrees]] += 1
        outside[row[passed]] += 1
    keep = (outside < 2) | (outside < 0.5 * inside)
    if keep.mean() < 0.5:
        return seen
    return SeenPoints(seen.points[keep], seen.normals[keep], seen.frames[keep], seen.pixel_m[keep])


def _pixel_normals(pixels: ScenePixels, camera, rows, v, u) -> np.ndarray:
    """Normals in camera space from central differences over two pixels; zero at depth edges."""
    maps = pixels.depth
    height, width = maps.shape[1:]

    def lift(vv: np.ndarray, uu: np.ndarray) -> np.ndarray:
        z = maps[rows, vv, uu].astype(np.float64)
        return np.stack(
            [(uu + 0.5 - camera.cx) / camera.fx * z, (vv + 0.5 - camera.cy) / camera.fy * z, z], -1
        )

    right, left = lift(v, np.minimum(u + 2, width - 1)), lift(v, np.maximum(u - 2, 0))
    down, up = lift(np.minimum(v + 2, height - 1), u), lift(np.maximum(v - 2, 0), u)
    here = lift(v, u)
    normal = np.cross(down - up, right - left)
    size = np.linalg.norm(normal, axis=1, keepdims=True)
    normal = np.divide(normal, size, out=np.zeros_like(normal), where=size > 1e-12)
    normal *= np.where(np.einsum("nk,nk->n", normal, here) > 0, -1.0, 1.0)[:, None]
    z = here[:, 2]
    around = np.stack([right[:, 2], left[:, 2], down[:, 2], up[:, 2]])
    same = (np.abs(around - z) < 0.03 * z).all(axis=0) & (around > 0).all(axis=0)
    same &= (pixels.ids[rows, v, np.minimum(u + 2, width - 1)] == pixels.ids[rows, v, u]) & (
        pixels.ids[rows, v, np.maximum(u - 2, 0)] == pixels.ids[rows, v, u]
    )
    return normal * same[:, None]
