"""Flat objects on walls (pictures, mirrors, boards) as slabs.

Their depth hardly differs from the wall's, so that a fused volume would be as thick as the depth noise. Image borders
often crop them: a side beyond which no frame saw wall is not the object's own. The slab is extended there until it is
square, the likeliest guess for a picture.
"""

from dataclasses import dataclass

import numpy as np

from reconstruction.assets.config import AssetsConfig
from reconstruction.assets.hanging_front import front_of
from reconstruction.assets.solid import Solid, box_solid
from reconstruction.assets.views import pixels_of
from reconstruction.assets.volume import ObjectFrame
from reconstruction.core.types import Camera, Instance, InstanceSet, PosedFrames
from registry.geometry import rigid, transform_points

_MAX_THICKNESS_M = 0.10
_MAX_SPREAD_M = 0.025  # of the points' distances to the wall (1-sigma)
_LAYER_M = 0.035  # least half width of the inlier band around the median distance
_MIN_FLAT_SHARE = 0.6  # inliers
_CELL_M, _MAX_CELLS = 0.008, 120  # occupancy grid on the wall
_MIN_COVERED = 0.5  # least coverage of a strip, relative to well covered ones
_MIN_STRIP = 4  # strips with fewer visible cells count as having this many
_EDGE_PX = 6.0  # depth is missing this close to the image border
_BEYOND_SHARE, _BEYOND_MIN_M = 0.04, 0.02  # distance of the probes from a side
_MIN_WITNESSES = 2  # frames
_PROBES = 7  # points along a side
_SEEN_SHARE, _SEEN_PERCENT = 0.5, 2.0  # least share of the box on the wall; percentile that bounds the points
_BEHIND_SHARE, _MOST_PERCENT = (
    0.35,
    80.0,
)  # points are the wall's where this percentage lies in that share of the depth


@dataclass(frozen=True)
class Hanging:
    """A slab in the grid frame, its back on the wall."""

    body: Solid
    completed: bool  # extended beyond what was seen


def is_outlined(item: Instance, points: np.ndarray) -> bool:
    """Tell whether the box of an object on a wall comes from its outlines rather than from its depth.

    That is so where its points (n, 3), in world space, cover little of the box, or lie on the wall behind it.
    """
    if not item.attached_hint:
        return False
    if len(points) == 0:
        return True
    depth_m = float(item.extents_m[0])
    out = np.array([np.cos(item.yaw_rad), np.sin(item.yaw_rad)])
    away = (points[:, :2] - item.center[:2]) @ out + 0.5 * depth_m
    if depth_m > _MAX_THICKNESS_M and np.percentile(away, _MOST_PERCENT) < _BEHIND_SHARE * depth_m:
        return True
    along = points[:, :2] @ np.array([-np.sin(item.yaw_rad), np.cos(item.yaw_rad)])
    low, high = np.percentile(
        np.column_stack([along, points[:, 2]]), [_SEEN_PERCENT, 100 - _SEEN_PERCENT], axis=0
    )
    return float(np.prod(high - low)) < _SEEN_SHARE * float(np.prod(item.extents_m[1:]))


def outlined_slab(
    item: Instance, posed: PosedFrames, camera: Camera, found: InstanceSet, config: AssetsConfig
) -> tuple[Solid, ObjectFrame]:
    """Return the box of an object known by its outline, its back on the wall, in a grid frame, and that frame.

    The images measure the thickness of a flat one (`front_of`).
    """
    c, s = np.cos(item.yaw_rad), np.sin(item.yaw_rad)
    front, width, height = item.extents_m
    rotation = np.array([[-s, -c, 0.0], [c, -s, 0.0], [0.0, 0.0, 1.0]])  # +y into the wall
    back = item.center - 0.5 * np.array([front * c, front * s, height])
    frame = ObjectFrame(rigid(rotation, back), np.zeros((0, 3)), np.zeros((0, 3)), False, 0.0)
    low, high = np.array([-0.5 * width, 0.0]), np.array([0.5 * width, height])
    if front <= config.flat_thickness_m:
        seen = front_of(frame.world_from_grid, 0.0, low, high, item.id, posed, camera, found)
        front = max(config.flat_thickness_m, seen or 0.0)
    return box_solid(np.array([low[0], -front, low[1]]), np.array([high[0], 0.0, high[1]])), frame


def hanging_slab(
    item: int,
    frame: ObjectFrame,
    posed: PosedFrames,
    camera: Camera,
    found: InstanceSet,
    config: AssetsConfig,
) -> Hanging | None:
    """Fit a slab to an object that hangs flat on its wall; None where it is thick, bent or not on a wall.

    +y of the grid frame points into the wall. `camera` has the resolution of the instance maps.
    """
    if frame.wall_y is None or len(frame.points) < config.min_points:
        return None
    away_m = frame.wall_y - frame.points[:, 1]
    thickness = float(np.median(away_m))
    spread = 1.4826 * float(np.median(np.abs(away_m - thickness)))
    # Depth puts a plain front at the wall, and the frame around it in front of the wall: both belong to the object.
    flat = np.abs(away_m - thickness) < max(2.5 * spread, _LAYER_M)
    if thickness > _MAX_THICKNESS_M or spread > _MAX_SPREAD_M or flat.mean() < _MIN_FLAT_SHARE:
        return None
    low, high = _covered_rectangle(frame, flat, posed, camera)
    front = front_of(frame.world_from_grid, frame.wall_y, low, high, item, posed, camera, found)
    thickness = max(thickness if front is None else front, config.flat_thickness_m)
    size = high - low
    if size.min() < 2 * thickness:
        return None
    new_low, new_high = low.copy(), high.copy()
    for axis in (0, 1):
        missing = size[1 - axis] - size[axis]
        if missing <= 0:
            continue
        open_low, open_high = (
            not _wall_beyond(frame, posed, camera, found, low, high, axis, upper) for upper in (False, True)
        )
        if open_low or open_high:
            share = 0.5 if open_low and open_high else 1.0
            new_low[axis] -= missing * share * open_low
            new_high[axis] += missing * share * open_high
    completed = bool((new_low < low).any() or (new_high > high).any())
    front, back = frame.wall_y - thickness, frame.wall_y
    body = box_solid(np.array([new_low[0], front, new_low[1]]), np.array([new_high[0], back, new_high[1]]))
    return Hanging(body, completed)


def _covered_rectangle(
    frame: ObjectFrame, flat: np.ndarray, posed: PosedFrames, camera: Camera
) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners (2,) x and z of the rectangle that the `flat` seen points cover.

    Coverage of a strip is relative to its cells that any frame could see, as few show the image border.
    """
    across = frame.points[flat][:, [0, 2]]
    start, end = across.min(axis=0), across.max(axis=0)
    cell = max(_CELL_M, float((end - start).max()) / _MAX_CELLS)
    index = np.floor((across - start) / cell).astype(int)
    shape = tuple(index.max(axis=0) + 1)
    counts = np.bincount(np.ravel_multi_index(index.T, shape), minlength=int(np.prod(shape)))
    filled = counts.reshape(shape) > 0
    x, z = np.meshgrid(*(start[k] + (np.arange(shape[k]) + 0.5) * cell for k in (0, 1)), indexing="ij")
    centers = np.stack([x, np.full(shape, frame.wall_y), z], axis=-1).reshape(-1, 3)
    visible = (
        _in_view(transform_points(frame.world_from_grid, centers), posed, camera).reshape(shape) | filled
    )
    low, high = np.empty(2), np.empty(2)
    for axis in (0, 1):
        covered = filled.sum(axis=1 - axis) / np.maximum(visible.sum(axis=1 - axis), _MIN_STRIP)
        strips = np.flatnonzero(covered >= _MIN_COVERED * np.percentile(covered, 90))
        low[axis] = start[axis] + strips[0] * cell
        high[axis] = start[axis] + (strips[-1] + 1) * cell
    return np.maximum(low, start), np.minimum(high, end)


def _in_view(world: np.ndarray, posed: PosedFrames, camera: Camera) -> np.ndarray:
    """Return which points (n, 3) are inside some image, `_EDGE_PX` from its border at least."""
    out = np.zeros(len(world), bool)
    for pose in posed.world_from_camera:
        local = (world - pose[:3, 3]) @ pose[:3, :3]
        in_front = local[:, 2] > 0.05
        local[:, 2] = np.maximum(local[:, 2], 1e-6)
        u, v = camera.project(local)
        out |= (
            in_front
            & (u > _EDGE_PX)
            & (v > _EDGE_PX)
            & (u < camera.width - _EDGE_PX)
            & (v < camera.height - _EDGE_PX)
        )
    return out


def _wall_beyond(
    frame: ObjectFrame, posed: PosedFrames, camera: Camera, found: InstanceSet, low: np.ndarray, high: np.ndarray,
    axis: int, upper: bool,
) -> bool:  # fmt: skip
    """Tell whether frames show floor or wall in most of a strip just beyond one side of the rectangle.

    That the image extends beyond it is not enough, as depth is missing along image borders.
    """
    beyond = max(_BEYOND_SHARE * float((high - low).max()), _BEYOND_MIN_M)
    probes = np.empty((_PROBES, 3))
    probes[:, 1] = frame.wall_y
    probes[:, 0 if axis == 0 else 2] = high[axis] + beyond if upper else low[axis] - beyond
    probes[:, 2 if axis == 0 else 0] = np.linspace(low[1 - axis], high[1 - axis], _PROBES)
    world = transform_points(frame.world_from_grid, probes)
    base = np.array([entity.id for entity in found.base])
    witnesses = 0
    for pose, ids in zip(posed.world_from_camera, found.id_maps):
        row, column, inside = pixels_of((world - pose[:3, 3]) @ pose[:3, :3], camera)
        seen = np.isin(ids[row[inside], column[inside]], base)
        witnesses += bool(seen.sum() > 0.5 * _PROBES)
        if witnesses >= _MIN_WITNESSES:
            return True
    return False
