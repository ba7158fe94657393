"""Floor, walls and ceiling: rectangles that reach as far as the room was seen, with looks baked from the frames."""

import cv2
import numpy as np

from reconstruction.assets.config import AssetsConfig
from reconstruction.assets.texture import Texels, collect_colors, prepare_looks, push_pull, textured
from reconstruction.assets.views import ScenePixels
from reconstruction.core.types import BaseAsset, BaseEntity, DepthMaps, InstanceSet, ObjectAsset, PosedFrames
from registry.geometry import invert_rigid, transform_points

_MARGIN_M = 0.05


def build_base(
    posed: PosedFrames, depth: DepthMaps, found: InstanceSet, objects: tuple[ObjectAsset, ...], pixels: ScenePixels,
    config: AssetsConfig,
) -> tuple[BaseAsset, ...]:  # fmt: skip
    """Build every base entity; the floor carries all objects and meets the walls, walls reach down to the floor."""
    frames = {b.id: _plane_frame(b) for b in found.base}
    floor = next((b for b in found.base if b.label == "floor"), None)
    out = []
    for entity in found.base:
        plane_from_world = frames[entity.id]
        points = [entity.surface.polygon]
        if entity.label == "floor":
            points += [transform_points(o.world_from_object, o.visual.vertices) for o in objects]
            points += [b.surface.polygon for b in found.base if b.label == "wall"]
        elif entity.label == "wall" and floor is not None:
            points.append(_drop_to(floor, entity.surface.polygon))
            points += [
                transform_points(o.world_from_object, o.visual.vertices)
                for o in objects
                if o.attached_hint and o.support_hint == entity.id
            ]
        flat = transform_points(plane_from_world, np.concatenate(points))[:, :2]
        low, high = flat.min(axis=0), flat.max(axis=0)
        if entity.label == "floor":
            low, high = low - _MARGIN_M, high + _MARGIN_M
            low, high = _stop_at_walls(low, high, plane_from_world, found)
        high = np.maximum(high, low + 0.1)
        out.append(_bake_rectangle(entity, plane_from_world, low, high, posed, depth, pixels, config))
    return tuple(out)


def _plane_frame(entity: BaseEntity) -> np.ndarray:
    """Return plane_from_world: z along the normal, the plane at z = 0, y up (or world y for level planes)."""
    n = entity.surface.plane[:3] / np.linalg.norm(entity.surface.plane[:3])
    d = entity.surface.plane[3] / np.linalg.norm(entity.surface.plane[:3])
    up = np.array([0, 0, 1.0]) if abs(n[2]) < 0.7 else np.array([0, 1.0, 0])
    x = np.cross(up, n)
    x /= np.linalg.norm(x)
    out = np.eye(4)
    out[:3, :3] = np.stack([x, np.cross(n, x), n])
    out[2, 3] = d
    return out


def _drop_to(floor: BaseEntity, points: np.ndarray) -> np.ndarray:
    """Move points straight down (or up) to the floor plane."""
    n, d = floor.surface.plane[:3], floor.surface.plane[3]
    out = points.copy()
    out[:, 2] = -(points[:, :2] @ n[:2] + d) / n[2]
    return out


def _stop_at_walls(
    low: np.ndarray, high: np.ndarray, plane_from_world: np.ndarray, found: InstanceSet
) -> tuple[np.ndarray, np.ndarray]:
    """Keep at least what walls span; the margin may pass behind a wall by its own width only."""
    for base in found.base:
        if base.label == "wall":
            flat = transform_points(plane_from_world, base.surface.polygon)[:, :2]
            low, high = np.minimum(low, flat.min(axis=0)), np.maximum(high, flat.max(axis=0))
    return low, high


def _bake_rectangle(
    entity: BaseEntity, plane_from_world: np.ndarray, low: np.ndarray, high: np.ndarray, posed: PosedFrames,
    depth: DepthMaps, pixels: ScenePixels, config: AssetsConfig,
) -> BaseAsset:  # fmt: skip
    world_from_plane = invert_rigid(plane_from_world)
    size = high - low
    vertices, faces, uvs = _grid(low, high, 0.5)
    side = 64
    while side < min(config.texture_max_px, float(size.max()) / config.base_texel_m):
        side *= 2
    side = min(side, config.texture_max_px)
    center = (np.arange(side) + 0.5) / side
    u, v = np.meshgrid(center, 1 - center)
    flat = np.stack([low[0] + u * size[0], low[1] + v * size[1], np.zeros_like(u)], -1).reshape(-1, 3)
    rows, columns = np.divmod(np.arange(side * side, dtype=np.int32), side)
    normal = np.repeat(world_from_plane[None, :3, 2], len(flat), axis=0)
    texels = Texels(rows, columns, transform_points(world_from_plane, flat), normal)
    color, seen = _collect(texels, entity, posed, depth, pixels, config)
    picture = np.zeros((side, side, 3), np.float32)
    filled = seen.reshape(side, side)
    picture[filled] = color[seen]
    picture = push_pull(picture, filled) if filled.any() else picture + 180.0
    mesh = textured(
        transform_points(world_from_plane, vertices),
        faces,
        uvs,
        np.clip(np.round(picture), 0, 255).astype(np.uint8),
    )
    plane = entity.surface.plane / np.linalg.norm(entity.surface.plane[:3])
    return BaseAsset(entity.id, entity.label, np.asarray(plane, np.float64), mesh, entity.observed)


def _grid(low: np.ndarray, high: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A rectangle of squares: vertices (v, 3) at z = 0, faces with normal +z, uvs (v, 2)."""
    nx, ny = (max(1, int(np.ceil((high[a] - low[a]) / step))) for a in range(2))
    s, t = np.meshgrid(np.linspace(0, 1, nx + 1), np.linspace(0, 1, ny + 1), indexing="ij")
    uvs = np.stack([s, t], -1).reshape(-1, 2)
    vertices = np.column_stack([low + uvs * (high - low), np.zeros(len(uvs))])
    index = np.arange((nx + 1) * (ny + 1)).reshape(nx + 1, ny + 1)
    a, b, c, d = (
        index[:-1, :-1].ravel(),
        index[1:, :-1].ravel(),
        index[1:, 1:].ravel(),
        index[:-1, 1:].ravel(),
    )
    return vertices, np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)]).astype(np.int32), uvs


def _collect(
    texels: Texels,
    entity: BaseEntity,
    posed: PosedFrames,
    depth: DepthMaps,
    pixels: ScenePixels,
    config: AssetsConfig,
) -> tuple[np.ndarray, np.ndarray]:
    """Blend colours from frames spread over the video."""
    count = (pixels.ids == entity.id).reshape(len(pixels.ids), -1).sum(axis=1)
    able = np.flatnonzero(count > 0.01 * pixels.ids[0].size)
    if len(able):
        able = able[
            np.unique(
                np.linspace(0, len(able) - 1, min(len(able), 2 * config.texture_frames)).round().astype(int)
            )
        ]
    views = [_base_view(entity, int(f), posed, depth, pixels) for f in able]
    looks = prepare_looks(posed, depth.camera, able, [v[0] for v in views], [v[1] for v in views])
    color, seen, _ = collect_colors(texels, looks, 0.02)
    return color, seen


def _base_view(
    entity: BaseEntity, frame: int, posed: PosedFrames, depth: DepthMaps, pixels: ScenePixels
) -> tuple[np.ndarray, np.ndarray]:
    """Depth of the plane where a frame sees it (0 elsewhere), and a weight that falls towards the mask's border."""
    camera = depth.camera
    n, d = entity.surface.plane[:3], entity.surface.plane[3]
    pose = posed.world_from_camera[frame]
    u = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    v = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    along = (n @ pose[:3, 0]) * u[None] + (n @ pose[:3, 1]) * v[:, None] + n @ pose[:3, 2]
    plane_depth = np.where(along < -1e-6, -(n @ pose[:3, 3] + d) / np.minimum(along, -1e-6), 0)
    measured = pixels.depth[frame]
    on_plane = np.abs(measured - plane_depth) < 0.02 + 0.02 * plane_depth
    mask = (pixels.ids[frame] == entity.id) & ((measured <= 0) | on_plane)
    # Contact shadows and badly cut outlines of objects stay out.
    mask = cv2.erode(mask.astype(np.uint8), np.ones((5, 5), np.uint8))
    border = np.minimum(cv2.distanceTransform(mask, cv2.DIST_L2, 3), 10.0) / 10.0
    return np.where(mask > 0, plane_depth, 0).astype(np.float32), border
