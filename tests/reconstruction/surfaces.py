"""Surfaces built by hand from sheets, with cameras that look at them: inputs of the instance tests."""

from dataclasses import dataclass, replace

import numpy as np

from reconstruction.core.rasterize import rasterize_mesh
from reconstruction.core.types import Camera, DepthMaps, PosedFrames, SpaceGrid, Surface, VideoSource
from reconstruction.surface import SurfaceConfig
from reconstruction.surface.planes import find_planes

STEP_M = 0.01


@dataclass
class Patchwork:
    """A triangle mesh while it is put together."""

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray
    colors: np.ndarray


def sheet(origin, u, v, color, step_m: float = STEP_M) -> Patchwork:
    """Return a rectangle from `origin` along vectors `u` and `v`, facing u x v, in cells of about `step_m`."""
    origin, u, v = (np.asarray(x, float) for x in (origin, u, v))
    nu, nv = (max(1, round(np.linalg.norm(x) / step_m)) for x in (u, v))
    s, t = np.meshgrid(np.linspace(0, 1, nu + 1), np.linspace(0, 1, nv + 1), indexing="ij")
    points = origin + s[..., None] * u + t[..., None] * v
    number = np.arange((nu + 1) * (nv + 1)).reshape(nu + 1, nv + 1)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    normal = np.cross(u, v) / np.linalg.norm(np.cross(u, v))
    count = points.size // 3
    return Patchwork(points.reshape(-1, 3), faces, np.tile(normal, (count, 1)), np.tile(color, (count, 1)))


def solid_box(low, high, color) -> Patchwork:
    """Return the five visible sides of a box that stands on something."""
    low, high = np.asarray(low, float), np.asarray(high, float)
    x, y, z = np.diag(high - low)
    return merged(
        sheet(low + z, x, y, color),
        sheet(low, x, z, color),
        sheet(low + x, y, z, color),
        sheet(low + x + y, -x, z, color),
        sheet(low + y, -y, z, color),
    )


def floor_sheet(color, half_m: float = 1.2, step_m: float = STEP_M) -> Patchwork:
    """Return a square floor at z = 0."""
    return sheet((-half_m, -half_m, 0), (2 * half_m, 0, 0), (0, 2 * half_m, 0), color, step_m)


def merged(*parts: Patchwork) -> Patchwork:
    """Join parts; vertices at the same place (the edges of boxes, contacts) become one, as after fusion."""
    offsets = np.cumsum([0] + [len(p.vertices) for p in parts[:-1]])
    vertices = np.concatenate([p.vertices for p in parts])
    faces = np.concatenate([p.faces + o for p, o in zip(parts, offsets)])
    normals = np.concatenate([p.normals for p in parts])
    colors = np.concatenate([p.colors for p in parts])
    _, first, inverse = np.unique(np.round(vertices / 1e-5), axis=0, return_index=True, return_inverse=True)
    inverse = inverse.reshape(-1)
    mean = np.stack([np.bincount(inverse, normals[:, k]) for k in range(3)], axis=1)
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-9)
    return Patchwork(vertices[first], inverse[faces], mean, colors[first])


def surface_from(patchwork: Patchwork) -> Surface:
    """Return the mesh as the surface stage would, with its planes; nothing is known of space."""
    space = SpaceGrid(np.zeros(3), 0.02, np.zeros((1, 1, 1), np.uint8))
    surface = Surface(
        patchwork.vertices.astype(np.float32),
        patchwork.faces.astype(np.int32),
        patchwork.normals.astype(np.float32),
        patchwork.colors.astype(np.uint8),
        np.full(len(patchwork.vertices), 5, np.float32),
        STEP_M,
        space,
    )
    return with_planes(surface)


def with_planes(surface: Surface) -> Surface:
    """Return a surface with the planes that the surface stage finds on it."""
    return replace(surface, planes=find_planes(surface, SurfaceConfig()))


def looking_at(position, target) -> np.ndarray:
    """Return world_from_camera of an upright OpenCV camera."""
    position, target = np.asarray(position, float), np.asarray(target, float)
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    out = np.eye(4)
    out[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    out[:3, 3] = position
    return out


def frames_of(surface: Surface, width: int = 120, height: int = 90) -> tuple[PosedFrames, DepthMaps]:
    """Film a surface from three sides with true depth."""
    camera = Camera(width, height, 0.9 * width, 0.9 * width, width / 2, height / 2)
    center = 0.5 * (surface.vertices.min(axis=0) + surface.vertices.max(axis=0))
    offsets = [(1.2, -1.8, 1.2), (-1.4, -1.6, 1.3), (0.2, 2.0, 1.4)]
    poses = np.stack([looking_at(center + np.array(o), center) for o in offsets])
    rasters = [rasterize_mesh(surface.vertices, surface.faces, camera, pose) for pose in poses]
    images = (
        np.stack([r.interpolate(surface.faces, surface.colors) for r in rasters]).round().astype(np.uint8)
    )
    depth = np.stack([r.depth for r in rasters])
    n = len(poses)
    posed = PosedFrames(
        VideoSource("made-by-hand", "0" * 64, width, height, 10.0, n, n / 10),
        camera, images, np.arange(n, dtype=np.int32), np.arange(n) / 10, poses, np.ones(n, np.float32),
        images[:0], np.zeros(0, np.int32), np.zeros(0), poses[:0],
        np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros(0, np.float32), np.zeros((0, 2), np.int32), n, True, 0.3,
    )  # fmt: skip
    return posed, DepthMaps(camera, depth, np.where(depth > 0, 2, 0).astype(np.uint8))


def filmed(
    truth: Patchwork, paint: np.ndarray, surface: Surface, poses: np.ndarray, camera: Camera
) -> tuple[PosedFrames, DepthMaps]:
    """Film what is there, of colors `paint` (n, 3); depth is that of a surface fused from it."""
    images = []
    for pose in poses:
        raster = rasterize_mesh(truth.vertices.astype(np.float32), truth.faces.astype(np.int32), camera, pose)
        images.append(raster.interpolate(truth.faces, paint).round().astype(np.uint8))
    depth = np.stack([rasterize_mesh(surface.vertices, surface.faces, camera, pose).depth for pose in poses])
    posed = replace(
        frames_of(surface)[0], camera=camera, images=np.stack(images), indices=np.arange(len(poses), dtype=np.int32),
        times_s=np.arange(len(poses)) / 10, world_from_camera=poses, sharpness=np.ones(len(poses), np.float32),
    )  # fmt: skip
    return posed, DepthMaps(camera, depth, np.where(depth > 0, 2, 0).astype(np.uint8))
