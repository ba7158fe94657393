"""Depth pixels of all frames with viewing angles and noise, computed once per scene, and the points of one object."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np

from reconstruction.core.rasterize import Raster, rasterize_mesh
from reconstruction.core.types import Camera, DepthMaps, PosedFrames
from reconstruction.core.workers import Workers
from registry.geometry import invert_rigid, transform_points

_OUTLINE_PX = 3  # depth and ids are unreliable this close to an instance's outline
_NEAR_M = 0.05  # nearer points do not project
MOST_AT_ONCE = 4  # objects worked on at once: each needs some 200 MB
FEW_PIXELS = 8  # frames that show no more of an object are ignored


@dataclass(frozen=True)
class ScenePixels:
    """Depth pixels of all frames with instance ids and viewing angles."""

    depth: np.ndarray  # float32 (n, h, w) z-depth, 0 = unknown
    confidence: np.ndarray  # uint8 (n, h, w)
    ids: np.ndarray  # uint16 (n, h, w)
    cosine: np.ndarray  # float32 (n, h, w) between ray and surface normal; 0 at depth discontinuities
    inner: np.ndarray  # bool (n, h, w) farther than `_OUTLINE_PX` from other instances
    noise_relative: float  # 1-sigma of depth over depth

    def counts(self, target: int) -> np.ndarray:
        """Return how many pixels of each frame show instance `target` (n,)."""
        return (self.ids == target).reshape(len(self.ids), -1).sum(axis=1)

    def places(self, target: int) -> tuple[np.ndarray, ...]:
        """Return frames, rows and columns int64 (k,), each, of the pixels with depth that show instance `target`."""
        shown = np.flatnonzero((self.ids == target) & (self.depth > 0))
        return np.unravel_index(shown, self.ids.shape)


def prepare_pixels(posed: PosedFrames, depth: DepthMaps, id_maps: np.ndarray) -> ScenePixels:
    """Compute viewing angles and the depth noise of a scene."""
    from reconstruction.assets.kernels import incidence_cosines

    maps = np.ascontiguousarray(depth.depth, np.float32)
    ids = np.ascontiguousarray(id_maps, np.uint16)
    return ScenePixels(
        maps,
        np.ascontiguousarray(depth.confidence, np.uint8),
        ids,
        incidence_cosines(maps, *depth.camera.intrinsics),
        inner_pixels(ids),
        measure_noise(posed, depth),
    )


def inner_pixels(ids: np.ndarray) -> np.ndarray:
    """Return which pixels (n, h, w) of id images have the same id everywhere within `_OUTLINE_PX`."""
    kernel = np.ones((2 * _OUTLINE_PX + 1,) * 2, np.uint8)
    return np.stack([cv2.erode(image, kernel) == cv2.dilate(image, kernel) for image in ids])


def rasterize_frames(
    vertices: np.ndarray, faces: np.ndarray, camera: Camera, poses: np.ndarray, take: Callable[[Raster], np.ndarray]
) -> np.ndarray:  # fmt: skip
    """Rasterize a mesh in all frames, on several threads; return what `take` keeps of each raster (n, ...).

    Args:
        vertices: (v, 3) in world space.
        faces: (f, 3).
        camera: of all frames.
        poses: world_from_camera (n, 4, 4).
        take: of a raster, e.g. its depth.
    """
    with ThreadPoolExecutor(Workers(0).threads) as pool:
        return np.array(
            list(pool.map(lambda pose: take(rasterize_mesh(vertices, faces, camera, pose)), poses))
        )


def pixels_of(
    local: np.ndarray, camera: Camera, border: int = 0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Project points (n, 3) of the camera's frame to pixels.

    Returns:
        Rows and columns int64 (n,), and which points lie in the image, `border` pixels from its edge at least.
    """
    u, v = camera.project(np.column_stack([local[:, :2], np.maximum(local[:, 2], 1e-6)]))
    row, column = np.floor(v).astype(int), np.floor(u).astype(int)
    inside = (local[:, 2] > _NEAR_M) & (column >= border) & (row >= border)
    return row, column, inside & (column < camera.width - border) & (row < camera.height - border)


def measure_noise(posed: PosedFrames, depth: DepthMaps) -> float:
    """Return the relative 1-sigma of depth from the agreement of near frames, within [0.0005, 0.02].

    Each second frame is warped into the one two frames later; differences above 4 % are occlusions, not noise.
    """
    camera, maps = depth.camera, depth.depth
    differences = []
    step = max(1, (camera.width * camera.height) // 1500)
    for a in range(0, len(maps) - 2, 2):
        b = a + 2
        flat = np.flatnonzero(np.asarray(maps[a]).ravel() > 0)[::step]
        v, u = np.divmod(flat, camera.width)
        local = camera.unproject(u + 0.5, v + 0.5, maps[a][v, u].astype(np.float64))
        world = transform_points(posed.world_from_camera[a], local)
        seen = transform_points(invert_rigid(posed.world_from_camera[b]), world)
        row, column, inside = pixels_of(seen, camera)
        there = maps[b][row[inside], column[inside]].astype(np.float64)
        relative = (there - seen[inside, 2]) / seen[inside, 2]
        differences.append(relative[(there > 0) & (np.abs(relative) < 0.04)])
    if not differences or sum(map(len, differences)) < 100:
        return 0.01
    # The 80 % quantile instead of the median, as errors have heavy tails, most of all on small objects.
    sigma = np.percentile(np.abs(np.concatenate(differences)), 80) / 1.2816 / np.sqrt(2.0)
    return float(np.clip(sigma, 0.0005, 0.02))


def object_noise(
    posed: PosedFrames, depth: DepthMaps, pixels: ScenePixels, seen: "SeenPoints", target: int
) -> float:
    """Return the relative 1-sigma of depth on one object, at least the scene's: small objects have noisier depth."""
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
        row, column, inside = pixels_of(local, depth.camera)
        f, u, v, z = f[inside], column[inside], row[inside], local[inside, 2]
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
    """Depth pixels of one object, unprojected to world space."""

    points: np.ndarray  # float64 (k, 3) world
    normals: np.ndarray  # float64 (k, 3) world, towards the camera; zero where unknown
    frames: np.ndarray  # int32 (k,) row of the keyframe
    pixel_m: np.ndarray  # float64 (k,) width of a pixel at the point


def lift_object(
    posed: PosedFrames, depth: DepthMaps, pixels: ScenePixels, target: int, limit: int = 60_000
) -> SeenPoints:
    """Unproject the depth pixels of instance `target`, evenly thinned to `limit` points at most, with normals."""
    camera = depth.camera
    rows, v, u = pixels.places(target)
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
    """Drop points that frames see past: they project outside the object's outline and nothing occludes them there.

    Outlines follow image edges; depth bleeds over them. Up to `votes` frames are asked.
    """
    shown = np.flatnonzero(pixels.counts(target) > FEW_PIXELS)
    if len(seen.points) == 0 or len(shown) < 4:
        return seen
    shown = shown[np.unique(np.linspace(0, len(shown) - 1, votes).round().astype(int))]
    inside, outside = np.zeros(len(seen.points), np.int32), np.zeros(len(seen.points), np.int32)
    for f in shown:
        local = transform_points(invert_rigid(posed.world_from_camera[f]), seen.points)
        v, u, valid = pixels_of(local, depth.camera, border=1)
        row = np.flatnonzero(valid)
        u, v, z = u[valid], v[valid], local[valid, 2]
        own = pixels.ids[f] == target
        beside = cv2.dilate(own.astype(np.uint8), cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))) > 0
        there = pixels.depth[f, v, u]
        agrees = own[v, u] & (np.abs(there - z) < 0.015 * z)
        passed = ~beside[v, u] & (there > z) & (pixels.cosine[f, v, u] > 0)
        inside[row[agrees]] += 1
        outside[row[passed]] += 1
    keep = (outside < 2) | (outside < 0.5 * inside)
    if keep.mean() < 0.5:
        return seen
    return SeenPoints(seen.points[keep], seen.normals[keep], seen.frames[keep], seen.pixel_m[keep])


def _pixel_normals(
    pixels: ScenePixels, camera: Camera, rows: np.ndarray, v: np.ndarray, u: np.ndarray
) -> np.ndarray:
    """Return normals (k, 3), camera frame, from central differences over two pixels; zero at depth discontinuities."""
    maps = pixels.depth
    height, width = maps.shape[1:]

    def lift(vv: np.ndarray, uu: np.ndarray) -> np.ndarray:
        return camera.unproject(uu + 0.5, vv + 0.5, maps[rows, vv, uu].astype(np.float64))

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
