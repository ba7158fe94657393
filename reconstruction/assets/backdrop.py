"""The backdrop: a textured shell around the scene, seen where no mesh is.

Walls without texture, windows, open doors and far rooms give no surface. Their pixels are rays of keyframes that hit no
mesh ("open" pixels). The shell is the box around everything in the scene, pushed out to the measured depth of open
pixels where that is farther: no part of it stands within the scene. Open pixels color it; the rest is interpolated.
It is drawn and never collides.
"""

import cv2
import numpy as np

from reconstruction.assets.config import AssetsConfig
from reconstruction.assets.shell import Shell, box_distance, room_shell
from reconstruction.assets.texture import Texels, collect_colors, push_pull, texture_views, textured
from reconstruction.assets.views import rasterize_frames
from reconstruction.core.types import Backdrop, Camera, DepthMaps, PosedFrames

_MARGIN_M = 0.1  # of the box around meshes; chords of the shell's grid stay outside of them
_CAMERA_MARGIN_M = 0.3  # of the box around cameras
_USUAL_HEIGHT_M = 2.5  # of rooms without a seen ceiling; building codes ask for 2.3 to 2.5 m
_MEASURED = 2  # confidence of a measured depth
_PIXEL_STEP = 3  # of the depth pixels that shape the shell
_ERODE_PX = 1  # open pixels this close to a mesh may show its outline
_RAMP_PX = (
    40.0  # weights grow up to this distance from outlines and the image's edge, so that frames blend smoothly
)
_THING_WEIGHT = 0.02  # of open pixels that show a segmented thing, whose mesh ends too early
_TOLERANCE_M = 0.1  # between a texel and the shell's depth at its pixel; the shell is smooth


def build_backdrop(
    posed: PosedFrames, depth: DepthMaps, ids: np.ndarray, vertices: np.ndarray, opened: np.ndarray,
    config: AssetsConfig,
) -> Backdrop:  # fmt: skip
    """Build the textured shell around a scene.

    Args:
        posed: keyframes in world space.
        depth: their depth maps, metres.
        ids: uint16 (n, h, w) instance ids of the keyframes' pixels at depth resolution, 0 = none.
        vertices: (v, 3) of all meshes, world space.
        opened: bool (n, h, w) pixels at which no mesh is.
        config: texture size.
    """
    poses = np.concatenate([posed.world_from_camera, posed.held_out_world_from_camera.reshape(-1, 4, 4)])
    low, high = room_box(vertices, poses)
    center = np.median(posed.world_from_camera[:, :3, 3], axis=0)
    shell = room_shell(center, low, high, *_open_points(opened, posed, depth, low, high))
    return _bake(shell, opened, ids, posed, depth.camera, config)


def room_box(vertices: np.ndarray, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners (3,), (3,) of the box around all meshes (v, 3) and cameras (n, 4, 4), as high as a room."""
    centers = poses[:, :3, 3]
    low = np.minimum(vertices.min(axis=0) - _MARGIN_M, centers.min(axis=0) - _CAMERA_MARGIN_M)
    high = np.maximum(vertices.max(axis=0) + _MARGIN_M, centers.max(axis=0) + _CAMERA_MARGIN_M)
    high[2] = max(high[2], _USUAL_HEIGHT_M)
    return low, high


def _open_points(
    opened: np.ndarray, posed: PosedFrames, depth: DepthMaps, low: np.ndarray, high: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the measured points (n, 3) of open pixels, and where open rays leave the box (k, 3)."""
    rays = depth.camera.pixel_rays()[::_PIXEL_STEP, ::_PIXEL_STEP]
    points, exits = [np.zeros((0, 3))], [np.zeros((0, 3))]
    for frame, pose in enumerate(posed.world_from_camera):
        part = opened[frame, ::_PIXEL_STEP, ::_PIXEL_STEP]
        directions = rays[part] @ pose[:3, :3].T
        exits.append(pose[:3, 3] + box_distance(pose[:3, 3], directions, low, high)[:, None] * directions)
        z = np.asarray(depth.depth[frame])[::_PIXEL_STEP, ::_PIXEL_STEP][part].astype(np.float64)
        measured = np.asarray(depth.confidence[frame])[::_PIXEL_STEP, ::_PIXEL_STEP][part] == _MEASURED
        points.append(pose[:3, 3] + (z[:, None] * directions)[measured & (z > 0)])
    return np.concatenate(points), np.concatenate(exits)


def _bake(
    shell: Shell, opened: np.ndarray, id_maps: np.ndarray, posed: PosedFrames, camera: Camera, config: AssetsConfig
) -> Backdrop:  # fmt: skip
    """Color a shell from the open pixels of all keyframes; texels that none shows are interpolated."""
    height, width = config.texture_max_px, 2 * config.texture_max_px
    rows, columns, color = _shown(shell, opened, id_maps, posed, camera, height, width)
    picture, drawn = np.zeros((height, width, 3), np.float32), np.zeros((height, width), bool)
    picture[rows, columns], drawn[rows, columns] = color, True
    if drawn.any():
        wide = push_pull(np.tile(picture, (1, 3, 1)), np.tile(drawn, (1, 3)))[:, width : 2 * width]
    else:
        wide = picture + 180.0
    texture = np.clip(np.round(wide), 0, 255).astype(np.uint8)
    return Backdrop(textured(*shell.mesh(), texture), float(drawn.mean()))


def _shown(
    shell: Shell, opened: np.ndarray, id_maps: np.ndarray, posed: PosedFrames, camera: Camera, height: int, width: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """Return rows and columns int32 (t,) of the texels that open pixels show, and their colors (t, 3)."""
    vertices, faces, _ = shell.mesh()
    frames = np.flatnonzero(opened.any(axis=(1, 2)))
    depths = rasterize_frames(vertices, faces, camera, posed.world_from_camera[frames], lambda r: r.depth)
    masks = np.array([_mask(opened[f], np.asarray(id_maps[f])) for f in frames]).reshape(depths.shape)
    depths[masks <= 0] = 0
    views = texture_views(posed, camera, frames, depths, masks)
    rows, columns = _looked_at(shell, views.depths, posed.world_from_camera[frames], camera, height, width)
    points = shell.at((columns + 0.5) / width, 1 - (rows + 0.5) / height)
    away = shell.center - points
    normals = away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-9)
    color, seen, _ = collect_colors(Texels(rows, columns, points, normals), views, _TOLERANCE_M)
    return rows[seen], columns[seen], color[seen]


def _mask(opened: np.ndarray, ids: np.ndarray) -> np.ndarray:
    """Return the weight (h, w) of a frame's open pixels, 0 for all others."""
    mask = cv2.erode(opened.astype(np.uint8), np.ones((2 * _ERODE_PX + 1,) * 2, np.uint8))
    inside = cv2.distanceTransform(np.pad(mask, 1), cv2.DIST_L2, 3)[1:-1, 1:-1]
    weight = np.minimum(inside, _RAMP_PX) / _RAMP_PX
    return np.where(ids == 0, weight, _THING_WEIGHT * weight).astype(np.float32)


def _looked_at(
    shell: Shell, depths: np.ndarray, poses: np.ndarray, camera: Camera, height: int, width: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return rows and columns int32 (t,) of the texels near the directions in which open pixels look."""
    coarse = np.zeros((height // 8, width // 8), np.uint8)
    rays = camera.pixel_rays()[::2, ::2]
    for shown, pose in zip(depths, poses):
        z = shown[::2, ::2]
        away = pose[:3, 3] + (z[..., None] * rays)[z > 0] @ pose[:3, :3].T - shell.center
        elevation = np.arctan2(away[:, 2], np.hypot(away[:, 0], away[:, 1])) / np.pi + 0.5
        azimuth = np.arctan2(away[:, 1], away[:, 0]) / (2 * np.pi) + 0.5
        row = np.clip(((1 - elevation) * coarse.shape[0]).astype(int), 0, coarse.shape[0] - 1)
        coarse[row, np.clip((azimuth * coarse.shape[1]).astype(int), 0, coarse.shape[1] - 1)] = 1
    near = cv2.dilate(coarse, np.ones((3, 3), np.uint8))
    fine = cv2.resize(near, (width, height), interpolation=cv2.INTER_NEAREST)
    rows, columns = np.nonzero(fine)
    return rows.astype(np.int32), columns.astype(np.int32)
