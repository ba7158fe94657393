"""Flat things on walls: pictures, mirrors, boards. A slab fits them better than any volume.

Their depth hardly differs from the wall's, so a fused volume is as thick as its noise. And they are often cut by the
image's edge: where no frame ever saw wall beyond a side, that side is not the thing's own, and the slab goes on until
it is as long as it is wide, which is the likeliest guess for a picture.
"""

from dataclasses import dataclass

import numpy as np

from reconstruction.assets.config import AssetsConfig
from reconstruction.assets.hanging_front import front_of
from reconstruction.assets.solid import Solid, box_solid
from reconstruction.assets.volume import ObjectFrame
from reconstruction.core.types import Camera, Instance, InstanceSet, PosedFrames
from registry.geometry import rigid, transform_points

_MAX_THICKNESS_M = 0.10
_MAX_SPREAD_M, _LAYER_M = 0.025, 0.035
_MIN_FLAT_SHARE = 0.6
_CELL_M, _MAX_CELLS = 0.008, 120
_MIN_COVERED = 0.5  # of what a well covered strip has
_MIN_STRIP = 4  # cells of a strip that must be in view to judge it by less
_EDGE_PX = 6.0
_BEYOND_SHARE, _BEYOND_MIN_M = 0.04, 0.02
_MIN_WITNESSES = 2
_PROBES = 7
_SEEN_SHARE, _SEEN_PERCENT = 0.5, 2.0  # of its box on the wall
_BEHIND_SHARE, _MOST_PERCENT = 0.35, 80.0  # of how far it stands out; of the points


@dataclass(frozen=True)
class Hanging:
    """A slab in the grid frame, its back on the wall."""

    body: Solid
    completed: bool  # it goes on where no frame looked


def is_outlined(item: Instance, points: np.ndarray) -> bool:
    """Tell whether the box of a thing on a wall is from its outlines.

    Few points (n, 3) were seen, or they are those of the wall behind it.
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
    """Return the box of what is known by its outline, its back on the wall, in a grid frame, and that frame.

    How thick a flat one is, views may tell.
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
    """Return the slab of a thing that hangs flat on its wall; None for what is thick, bent or not on a wall.

    Args:
        item: The thing's id.
        frame: What was seen of the thing; +y of its grid frame looks into the wall.
        posed: The keyframes' poses, in world space.
        camera: The camera at the resolution of the instance maps.
        found: Its instance maps tell where wall was seen beyond the thing.
        config: `flat_thickness_m` is the least thickness.
    """
    if frame.wall_y is None or len(frame.points) < config.min_points:
        return None
    away_m = frame.wall_y - frame.points[:, 1]
    thickness = float(np.median(away_m))
    spread = 1.4826 * float(np.median(np.abs(away_m - thickness)))
    # Depth takes a plain front for the wall behind it, and finds the frame around it: both are the thing.
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
    """Return the corners (2,) x and z of the rectangle that the `flat` ones of the seen points cover.

    What counts is that a strip is covered where any frame could see it, not how often: the part at the image's edge is
    in few frames only.
    """
    across = frame.points[flat][:, [0, 2]]
    start, end = across.min(axis=0), across.max(axis=0)
    cell = max(_CELL_M, float((end - start).max()) / _MAX_CELLS)
    index = np.floor((across - start) / cell).astype(int)
    shape = tuple(index.max(axis=0) + 1)
    filled = (
        np.bincount(np.ravel_multi_index(index.T, shape), minlength=int(np.prod(shape))).reshape(shape) > 0
    )
    x, z = np.meshgrid(*(start[k] + (np.arange(shape[k]) + 0.5) * cell for k in (0, 1)), indexing="ij")
    centers = np.stack([x, np.full(shape, frame.wall_y), z], axis=-1).reshape(-1, 3)
    visible = filled | _in_view(transform_points(frame.world_from_grid, centers), posed, camera).reshape(
        shape
    )
    low, high = np.empty(2), np.empty(2)
    for axis in (0, 1):
        covered = filled.sum(axis=1 - axis) / np.maximum(visible.sum(axis=1 - axis), _MIN_STRIP)
        strips = np.flatnonzero(covered >= _MIN_COVERED * np.percentile(covered, 90))
        low[axis] = start[axis] + strips[0] * cell
        high[axis] = start[axis] + (strips[-1] + 1) * cell
    return np.maximum(low, start), np.minimum(high, end)


def _in_view(world: np.ndarray, posed: PosedFrames, camera: Camera) -> np.ndarray:
    """Return which points (n, 3) are inside some frame and off its very edge, where depth is missing."""
    out = np.zeros(len(world), bool)
    for pose in posed.world_from_camera:
        local = (world - pose[:3, 3]) @ pose[:3, :3]
        z = np.maximum(local[:, 2], 1e-6)
        u, v = camera.fx * local[:, 0] / z + camera.cx, camera.fy * local[:, 1] / z + camera.cy
        inside = (
            (u > _EDGE_PX) & (v > _EDGE_PX) & (u < camera.width - _EDGE_PX) & (v < camera.height - _EDGE_PX)
        )
        out |= inside & (local[:, 2] > 0.05)
    return out


def _wall_beyond(
    frame: ObjectFrame, posed: PosedFrames, camera: Camera, found: InstanceSet, low: np.ndarray, high: np.ndarray,
    axis: int, upper: bool,
) -> bool:  # fmt: skip
    """Tell whether frames show floor or wall in most of a strip just beyond one side of the rectangle.

    That the image goes on there is not enough: depth is missing along the image's edges.
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
        local = (world - pose[:3, 3]) @ pose[:3, :3]
        z = np.maximum(local[:, 2], 1e-6)
        column = np.floor(camera.fx * local[:, 0] / z + camera.cx).astype(int)
        row = np.floor(camera.fy * local[:, 1] / z + camera.cy).astype(int)
        inside = (local[:, 2] > 0.05) & (column >= 0) & (row >= 0)
        inside &= (column < camera.width) & (row < camera.height)
        seen = np.isin(ids[row[inside], column[inside]], base)
        witnesses += bool(seen.sum() > 0.5 * _PROBES)
        if witnesses >= _MIN_WITNESSES:
            return True
    return False
