"""Floor, walls and ceiling: rectangles with textures baked from the frames."""

from collections.abc import Sequence

import cv2
import numpy as np

from reconstruction.assets.base_rectangles import Rectangle
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
from reconstruction.core.types import BaseAsset, BaseEntity, Camera, DepthMaps, PosedFrames
from registry.geometry import transform_points

_GRID_M = 0.5  # edge of the squares of a rectangle's mesh
_TOLERANCE_M = 0.02  # between a texel and the depth of its plane at a pixel


def bake_base(
    rectangles: Sequence[Rectangle], hits: np.ndarray, fixed: np.ndarray, posed: PosedFrames, depth: DepthMaps,
    pixels: ScenePixels, config: AssetsConfig,
) -> tuple[BaseAsset, ...]:  # fmt: skip
    """Make textured meshes of the rectangles of floor, walls and ceiling.

    Args:
        rectangles: extents on their planes.
        hits: uint16 (n, h, w) id of the nearest mesh of the scene at each pixel of the keyframes, 0 = none.
        fixed: bool (n, h, w) pixels that show no base entity and nothing that may move.
        posed: keyframes in world space.
        depth: their depth maps, metres.
        pixels: their ids.
        config: texel size and budget.
    """
    return tuple(
        _bake_rectangle(r, (hits == r.entity.id) & fixed, posed, depth, pixels, config) for r in rectangles
    )


def rectangle_mesh(rectangle: Rectangle) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return world vertices (v, 3), faces (f, 3) and uvs (v, 2) of a rectangle."""
    vertices, faces, uvs = _grid(rectangle.low, rectangle.high, _GRID_M)
    return transform_points(rectangle.world_from_plane, vertices), faces, uvs


def _bake_rectangle(
    rectangle: Rectangle, spare: np.ndarray, posed: PosedFrames, depth: DepthMaps, pixels: ScenePixels,
    config: AssetsConfig,
) -> BaseAsset:  # fmt: skip
    entity, low, size = rectangle.entity, rectangle.low, rectangle.high - rectangle.low
    vertices, faces, uvs = rectangle_mesh(rectangle)
    side = texture_side(float(size.max()) / config.base_texel_m, 64, config.texture_max_px)
    center = (np.arange(side) + 0.5) / side
    u, v = np.meshgrid(center, 1 - center)
    flat = np.stack([low[0] + u * size[0], low[1] + v * size[1]], -1).reshape(-1, 2)
    rows, columns = np.divmod(np.arange(side * side, dtype=np.int32), side)
    normal = np.repeat(rectangle.normal[None], len(flat), axis=0)
    texels = Texels(rows, columns, rectangle.world(flat), normal)
    color, seen = _collect(texels, entity, posed, depth, pixels, config)
    share = float(seen.mean())
    _fill(texels, color, seen, entity, spare, posed, depth, config)
    picture = np.zeros((side, side, 3), np.float32)
    filled = seen.reshape(side, side)
    picture[filled] = color[seen]
    picture = push_pull(picture, filled) if filled.any() else picture + 180.0
    mesh = textured(vertices, faces, uvs, np.clip(np.round(picture), 0, 255).astype(np.uint8))
    plane = entity.surface.plane / np.linalg.norm(entity.surface.plane[:3])
    return BaseAsset(entity.id, entity.label, np.asarray(plane, np.float64), mesh, entity.observed, share)


def _fill(
    texels: Texels, color: np.ndarray, seen: np.ndarray, entity: BaseEntity, spare: np.ndarray, posed: PosedFrames,
    depth: DepthMaps, config: AssetsConfig,
) -> None:  # fmt: skip
    """Color texels that no frame shows for certain from the pixels `spare` (n, h, w) that hit the surface, in place.

    Such pixels have no depth (textureless or dark surface), or show a thing whose mesh ends too early (a curtain).
    """
    frames = _spread_frames(spare.reshape(len(spare), -1).sum(axis=1), spare[0].size, config)
    if seen.all() or not len(frames):
        return
    planes = [_plane_depth(entity, int(f), posed, depth.camera) for f in frames]
    masks = [_inner_weight(spare[f]) for f in frames]
    depths = [np.where(mask > 0, plane, 0).astype(np.float32) for mask, plane in zip(masks, planes)]
    index = np.flatnonzero(~seen)
    rest = Texels(texels.rows[index], texels.columns[index], texels.points[index], texels.normals[index])
    views = texture_views(posed, depth.camera, frames, depths, masks)
    more, shown, _ = collect_colors(rest, views, _TOLERANCE_M)
    color[index[shown]] = more[shown]
    seen[index[shown]] = True


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
    able = _spread_frames(pixels.counts(entity.id), pixels.ids[0].size, config)
    masks = [_base_view(entity, int(f), posed, depth, pixels) for f in able]
    views = texture_views(posed, depth.camera, able, [m[0] for m in masks], [m[1] for m in masks])
    color, seen, _ = collect_colors(texels, views, _TOLERANCE_M)
    return color, seen


def _spread_frames(count: np.ndarray, size: int, config: AssetsConfig) -> np.ndarray:
    """Return rows of frames, spread over the video, in which a surface has more than 1 % of `size` pixels."""
    able = np.flatnonzero(count > 0.01 * size)
    most = min(len(able), 2 * config.texture_frames)
    return able[np.unique(np.linspace(0, len(able) - 1, most).round().astype(int))] if len(able) else able


def _plane_depth(entity: BaseEntity, frame: int, posed: PosedFrames, camera: Camera) -> np.ndarray:
    """Return the z-depth (h, w) of a base entity's plane in a frame, 0 where it is not in front."""
    n, d = entity.surface.plane[:3], entity.surface.plane[3]
    pose = posed.world_from_camera[frame]
    u, v = camera.pixel_rays()[..., :2].transpose(2, 0, 1)
    along = (n @ pose[:3, 0]) * u + (n @ pose[:3, 1]) * v + n @ pose[:3, 2]
    return np.where(along < -1e-6, -(n @ pose[:3, 3] + d) / np.minimum(along, -1e-6), 0)


def _base_view(
    entity: BaseEntity, frame: int, posed: PosedFrames, depth: DepthMaps, pixels: ScenePixels
) -> tuple[np.ndarray, np.ndarray]:
    """Return the plane's depth where a frame sees it (0 elsewhere), and a weight that falls towards the mask's edge."""
    plane_depth = _plane_depth(entity, frame, posed, depth.camera)
    measured = pixels.depth[frame]
    on_plane = np.abs(measured - plane_depth) < 0.02 + 0.02 * plane_depth
    weight = _inner_weight((pixels.ids[frame] == entity.id) & ((measured <= 0) | on_plane))
    return np.where(weight > 0, plane_depth, 0).astype(np.float32), weight


def _inner_weight(mask: np.ndarray) -> np.ndarray:
    """Return weights float32 (h, w) that fall towards a mask's edge, 0 near it.

    This excludes contact shadows and pixels of objects along inexact outlines.
    """
    inner = cv2.erode(mask.astype(np.uint8), np.ones((5, 5), np.uint8))
    return np.minimum(cv2.distanceTransform(inner, cv2.DIST_L2, 3), 10.0) / 10.0
