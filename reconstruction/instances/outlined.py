"""Things on walls whose depth was not measured: their masks' outlines on the plane of the wall say where they are.

A picture in the corner of a few frames, or a shelf seen edge on, has no surface of its own, or a scrap of it. Its
wall has a plane, and masks have outlines: the rays through an outline meet the plane. How far a thing stands out from
its wall is tried: the box must look like the masks in every frame that shows it.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np

from reconstruction.core.mesh_graph import lab_from_rgb
from reconstruction.core.progress import Progress
from reconstruction.core.rasterize import rasterize_mesh
from reconstruction.core.types import DepthMaps, Instance, InstanceSet, PosedFrames, Surface
from reconstruction.instances.colors import LIGHTNESS_WEIGHT
from reconstruction.instances.config import InstancesConfig
from reconstruction.instances.masks.base import FrameMasks
from reconstruction.instances.outlined_box import MIN_FRONT_M, Wall, WallBox, Window, fit_box, silhouette

_LEAST_SHARE, _MOST_SHARE = 1e-3, 0.2  # of the image, for a mask to be looked at
_RING_PX, _ON_WALL = 4, 0.6  # of a ring around its mask must be that wall
_BEFORE, _HIDDEN_SHARE = (
    0.96,
    0.3,
)  # of the wall's depth; what is drawn nearer there is another thing, or its own
_OTHER_COLOR = 8.0  # a piece of wall has the color of the wall around it
_INSIDE_M, _INSIDE_SHARE = 0.1, 0.95  # beyond another wall is not in the room
_SAME_IOU, _AGREED = 0.3, 0.5  # of the frames that see its place must show it
_MAX_SIDE_M = 2.5
_OWN_SHARE = 0.6  # of its outline: with more surface than this a thing needs no outline


@dataclass(frozen=True)
class _Sight:
    """One mask on one wall."""

    wall: int  # base id
    row: int  # of its frame
    name: int  # id of the thing with surface that it is said to show, 0 for none
    window: Window


def add_outlined(
    found: InstanceSet, asked: FrameMasks, told: FrameMasks, posed: PosedFrames, depth: DepthMaps, surface: Surface,
    config: InstancesConfig, progress: Progress,
) -> InstanceSet:  # fmt: skip
    """Return the instances with things on walls that only their masks show, and with whole boxes of those half seen.

    Args:
        found: what has surface.
        asked: the masks, at the resolution of `told`.
        told: the same with the ids of `found`; 0 where masks say nothing of the surface.
        posed: keyframes.
        depth: their depth; its camera is the masks' here.
        surface: what hides what.
        config: the least size of a picture.
        progress: told of what was found.
    """
    walls = [Wall.of(b) for b in found.base if b.label == "wall" and b.observed]
    if not walls:
        return found
    drawn = [
        rasterize_mesh(surface.vertices, surface.faces, told.camera, pose).depth
        for pose in told.world_from_camera
    ]
    sights = [
        s for row in range(len(told.ids)) for s in _sights(found, asked, told, posed, walls, drawn[row], row)
    ]
    objects, maps, count = list(found.objects), found.id_maps.copy(), 0
    for group in _grouped(sights):
        wall = next(w for w in walls if w.id == group[0].wall)
        box = fit_box(wall, [s.window for s in group])
        if min(box.size) < config.min_picture_m or max(box.size) > _MAX_SIDE_M:
            continue
        rows = {s.row for s in group}
        if len(rows) < _AGREED * _visible(box, wall, told, drawn):
            continue
        names = {s.name for s in group} - {0}
        own = next((k for k, o in enumerate(objects) if o.id in names), None)
        number = objects[own].id if own is not None else max([*(o.id for o in objects), len(found.base)]) + 1
        made = _instance_on_wall(number, box, wall, objects[own] if own is not None else None)
        if own is None:
            objects.append(made)
        else:
            objects[own] = made
        _draw_box(maps, number, box, wall, posed, depth, surface, found)
        count += 1
    if not count:
        return found
    progress.note(
        f"{count} things on walls have the size of their masks' outlines: depth shows too little of them"
    )
    return replace(found, objects=tuple(objects), id_maps=maps)


def _sights(
    found: InstanceSet, asked: FrameMasks, told: FrameMasks, posed: PosedFrames, walls: list[Wall], drawn: np.ndarray,
    row: int,
) -> list[_Sight]:  # fmt: skip
    """Return what of a frame's masks may hang on a wall without enough surface to say so."""
    ids, names, pose = asked.ids[row], told.ids[row], np.asarray(told.world_from_camera[row], np.float64)
    attached = {o.id: o for o in found.objects if o.attached_hint}
    base = {b.id for b in found.base}
    image = _image_of(posed, int(told.frame_indices[row]), told)
    out = []
    kernel = np.ones((2 * _RING_PX + 1,) * 2, np.uint8)
    for number, area in enumerate(np.bincount(ids.ravel())):
        if number == 0 or not _LEAST_SHARE * ids.size <= area <= _MOST_SHARE * ids.size:
            continue
        mask = ids == number
        name = int(np.bincount(names[mask]).argmax())
        if name not in base and name not in attached and name != 0:
            continue
        ring = (cv2.dilate(mask.astype(np.uint8), kernel) > 0) & ~mask
        around = np.bincount(names[ring], minlength=max(base) + 1)
        wall = next((w for w in walls if around[w.id] > _ON_WALL * ring.sum()), None)
        if wall is None:
            continue
        window = Window.of(mask, wall, told.camera, pose)
        if window is None or not _in_room(window, wall, found):
            continue
        before = (drawn > 0) & (drawn < _BEFORE * wall.depth(told.camera, pose)) & mask
        if before.sum() > _HIDDEN_SHARE * area and name not in attached:
            continue
        if name in attached:
            if _has_surface(attached[name], window):
                continue
        elif image is None or not _differs(image, mask, ring & (names == wall.id)):
            continue
        out.append(_Sight(wall.id, row, name if name in attached else 0, window))
    return out


def _image_of(posed: PosedFrames, index: int, told: FrameMasks) -> np.ndarray | None:
    """Return the picture of a frame in Lab at the masks' resolution."""
    for indices, images in ((posed.indices, posed.images), (posed.held_out_indices, posed.held_out_images)):
        rows = np.flatnonzero(np.asarray(indices) == index)
        if len(rows) and len(images):
            size = (told.camera.width, told.camera.height)
            return lab_from_rgb(cv2.resize(np.asarray(images[rows[0]]), size, interpolation=cv2.INTER_AREA))
    return None


def _differs(lab: np.ndarray, mask: np.ndarray, ring: np.ndarray) -> bool:
    if not ring.any():
        return False
    ground = np.median(lab[ring] * LIGHTNESS_WEIGHT, axis=0)
    return bool(np.median(np.linalg.norm(lab[mask] * LIGHTNESS_WEIGHT - ground, axis=1)) > _OTHER_COLOR)


def _in_room(window: Window, wall: Wall, found: InstanceSet) -> bool:
    """Tell whether an outline on its wall's plane is within the room's other planes."""
    corners = wall.points(window.outline)
    planes = [b.surface.plane for b in found.base if b.id != wall.id and b.observed]
    return all((corners @ p[:3] + p[3] > -_INSIDE_M).mean() >= _INSIDE_SHARE for p in planes)


def _has_surface(item: Instance, window: Window) -> bool:
    """Tell whether the box of what has surface is about as large as its outline."""
    low, high = window.outline.min(axis=0), window.outline.max(axis=0)
    return float(np.prod(item.extents_m[1:])) > _OWN_SHARE * float(np.prod(high - low))


def _grouped(sights: list[_Sight]) -> list[list[_Sight]]:
    """Group sights of one thing: on one wall, at one place."""
    groups: list[list[_Sight]] = []
    for sight in sorted(sights, key=lambda s: -float(np.prod(np.ptp(s.window.outline, axis=0)))):
        for group in groups:
            same = sight.wall == group[0].wall and sight.row not in {s.row for s in group}
            if same and any(_iou(sight.window, s.window) > _SAME_IOU for s in group):
                group.append(sight)
                break
        else:
            groups.append([sight])
    return groups


def _iou(first: Window, second: Window) -> float:
    """Return the common area of two rectangles on a wall, of the smaller one: the picture's edge cuts some off."""
    low = np.maximum(first.outline.min(axis=0), second.outline.min(axis=0))
    high = np.minimum(first.outline.max(axis=0), second.outline.max(axis=0))
    areas = [float(np.prod(np.ptp(w.outline, axis=0))) for w in (first, second)]
    return float(np.prod(np.maximum(high - low, 0.0))) / max(min(areas), 1e-9)


def _visible(box: WallBox, wall: Wall, told: FrameMasks, drawn: list[np.ndarray]) -> int:
    """Return how many of the masks' frames see the middle of a box, with nothing before it."""
    middle = wall.points(np.array([(box.low + box.high) / 2]))[0]
    count = 0
    for pose, near in zip(told.world_from_camera, drawn):
        local = (middle - pose[:3, 3]) @ pose[:3, :3]
        if local[2] < 0.05:
            continue
        u = told.camera.fx * local[0] / local[2] + told.camera.cx
        v = told.camera.fy * local[1] / local[2] + told.camera.cy
        if 0 <= u < told.camera.width and 0 <= v < told.camera.height:
            there = near[int(v), int(u)]
            count += there <= 0 or there > _BEFORE * local[2] - box.front
    return count


def _instance_on_wall(number: int, box: WallBox, wall: Wall, old: Instance | None) -> Instance:
    """Return a thing with this box on its wall: `old` with another box, or a new one."""
    along = (box.low[0] + box.high[0]) / 2
    center = np.array([*(along * wall.along + (0.5 * box.front - wall.offset) * wall.normal)[:2], 0.0])
    center[2] = (box.low[1] + box.high[1]) / 2
    extents = np.array([box.front, *box.size])
    if old is not None:
        return replace(old, center=center, yaw_rad=wall.yaw, extents_m=extents)
    flat = box.front <= MIN_FRONT_M and min(box.size) > 0.2
    label, confidence = ("picture", 0.3) if flat else ("unknown", 0.0)
    return Instance(number, label, confidence, center, wall.yaw, extents, wall.id, True)


def _draw_box(
    maps: np.ndarray, number: int, box: WallBox, wall: Wall, posed: PosedFrames, depth: DepthMaps, surface: Surface,
    found: InstanceSet,
) -> None:  # fmt: skip
    """Write a thing into the id maps where its box shows and nothing else does."""
    free = np.array([0, wall.id, number])
    for row, pose in enumerate(posed.world_from_camera):
        shape = silhouette(box, wall, depth.camera, np.asarray(pose, np.float64))
        if shape is None:
            continue
        own = shape & np.isin(maps[row], free)
        measured = np.asarray(depth.depth[row])
        own &= ~((measured > 0) & (measured < _BEFORE * wall.depth(depth.camera, pose) - box.front))
        maps[row][own] = number
