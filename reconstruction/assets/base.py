"""Floor, walls and ceiling: rectangles as large as the seen room, with textures baked from the frames."""

import cv2
import numpy as np

from reconstruction.assets.config import AssetsConfig
from reconstruction.assets.texture import (
    Texels,
    collect_colors,
    push_pull,
    texture_side,
    texture_views,
    textured,
)
from reconstruction.assets.views import ScenePixels
from reconstruction.core.types import BaseAsset, BaseEntity, DepthMaps, InstanceSet, ObjectAsset, PosedFrames
from registry.geometry import invert_rigid, transform_points

_MARGIN_M = 0.05  # of the floor beyond what was seen


def build_base(
    posed: PosedFrames, depth: DepthMaps, found: InstanceSet, objects: tuple[ObjectAsset, ...], pixels: ScenePixels,
    config: AssetsConfig,
) -> tuple[BaseAsset, ...]:  # fmt: skip
    """Build every base entity: the floor extends below all objects and to the walls, walls extend down to the floor."""
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
            low, high = _include_walls(low - _MARGIN_M, high + _MARGIN_M, plane_from_world, found)
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
    """Move points vertically onto the floor plane."""
    n, d = floor.surface.plane[:3], floor.surface.plane[3]
    out = points.copy()
    out[:, 2] = -(points[:, :2] @ n[:2] + d) / n[2]
    return out


def _include_walls(
    low: np.ndarray, high: np.ndarray, plane_from_world: np.ndarray, found: InstanceSet
) -> tuple[np.ndarray, np.ndarray]:
    """Grow a rectangle to what the walls span."""
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
    side = texture_side(float(size.max()) / config.base_texel_m, 64, config.texture_max_px)
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
    """Return a rectangle of squares: vertices (v, 3) at z = 0, faces with normal +z, uvs (v, 2)."""
    nx, ny = (max(1, int(np.ceil((high[a] - low[a]) / step))) for a in range(2))
    s, t = np.meshgrid(np.linspace(0, 1, nx + 1), np.linspace(0, 1, ny + 1), indexing="ij")
    uvs = np.stack([s, t], -1).reshape(-1, 2)
    vertices = np.column_stack([low + uvs * (high - low), np.zeros(len(uvs))])
    index = np.arange((nx + 1) * (ny + 1)).reshape(nx + 1, ny + 1)
    a, b = index[:-1, :-1].ravel(), index[1:, :-1].ravel()
    c, d = index[1:, 1:].ravel(), index[:-1, 1:].ravel()
    return vertices, np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)]).astype(np.int32), uvs


def _collect(
    texels: Texels, entity: BaseEntity, posed: PosedFrames, depth: DepthMaps, pixels: ScenePixels,
    config: AssetsConfig,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Blend colors from frames spread over the video: colors (t, 3) and whether any frame saw them (t,)."""
    count = pixels.counts(entity.id)
    able = np.flatnonzero(count > 0.01 * pixels.ids[0].size)
    if len(able):
        count = min(len(able), 2 * config.texture_frames)
        able = able[np.unique(np.linspace(0, len(able) - 1, count).round().astype(int))]
    masks = [_base_view(entity, int(f), posed, depth, pixels) for f in able]
    views = texture_views(posed, depth.camera, able, [m[0] for m in masks], [m[1] for m in masks])
    color, seen, _ = collect_colors(texels, views, 0.02)
    return color, seen


def _base_view(
    entity: BaseEntity, frame: int, posed: PosedFrames, depth: DepthMaps, pixels: ScenePixels
) -> tuple[np.ndarray, np.ndarray]:
    """Return the plane's depth where a frame sees it (0 elsewhere), and a weight that falls towards the mask's edge."""
    n, d = entity.surface.plane[:3], entity.surface.plane[3]
    pose = posed.world_from_camera[frame]
    u, v = depth.camera.pixel_rays()[..., :2].transpose(2, 0, 1)
    along = (n @ pose[:3, 0]) * u + (n @ pose[:3, 1]) * v + n @ pose[:3, 2]
    plane_depth = np.where(along < -1e-6, -(n @ pose[:3, 3] + d) / np.minimum(along, -1e-6), 0)
    measured = pixels.depth[frame]
    on_plane = np.abs(measured - plane_depth) < 0.02 + 0.02 * plane_depth
    mask = (pixels.ids[frame] == entity.id) & ((measured <= 0) | on_plane)
    # Excludes contact shadows and pixels of objects along inexact outlines.
    mask = cv2.erode(mask.astype(np.uint8), np.ones((5, 5), np.uint8))
    border = np.minimum(cv2.distanceTransform(mask, cv2.DIST_L2, 3), 10.0) / 10.0
    return np.where(mask > 0, plane_depth, 0).astype(np.float32), border
