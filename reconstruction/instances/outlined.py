"""Boxes of wall-mounted objects from mask outlines, for objects whose depth was not measured.

A picture in the corner of a few frames, or a shelf seen edge on, has hardly any surface of its own. The rays through
its masks are intersected with the plane of the wall. How far the object stands out is found by search: the silhouette
of the box must match the masks of all frames.
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
from reconstruction.instances.outlined_box import MIN_FRONT_M, Wall, WallBox, WallMask, fit_box, silhouette

_LEAST_SHARE, _MOST_SHARE = 1e-3, 0.2  # size of a candidate mask, of the image
_RING_PX, _ON_WALL = 4, 0.6  # width of the ring around a mask, and the least share of it that is the wall
_BEFORE = 0.96  # of the wall's depth: surface nearer than this is in front of the wall
_HIDDEN_SHARE = 0.3  # largest share of a mask that another object's surface may fill
_OTHER_COLOR = 8.0  # least CIELAB distance to the wall around the mask: less is a piece of the wall
_INSIDE_M, _INSIDE_SHARE = 0.1, 0.95  # share of the outline inside the room, up to this far beyond its planes
_SAME_OVERLAP = 0.3  # of the smaller of two masks on one wall: with more overlap they are of one object
_AGREED = 0.5  # of the frames that see the center of the box must have a mask there
_MAX_SIDE_M = 2.5
_OWN_SHARE = 0.6  # of the outline's area: an object whose surface covers more keeps its own box


@dataclass(frozen=True)
class _Candidate:
    """A mask that may be a wall-mounted object."""

    wall: int  # base id
    row: int  # of its frame
    name: int  # id of the object that the mask is labeled with, 0 = none
    mask: WallMask


def add_outlined(
    found: InstanceSet, masks: FrameMasks, labeled: FrameMasks, posed: PosedFrames, depth: DepthMaps, surface: Surface,
    config: InstancesConfig, progress: Progress,
) -> InstanceSet:  # fmt: skip
    """Add wall-mounted objects that only masks show, and replace the boxes of those with too little surface.

    `labeled` are the masks with ids of `found`, 0 = none. Both have the camera of the depth maps.
    """
    walls = {b.id: Wall.of(b) for b in found.base if b.label == "wall" and b.observed}
    if not walls:
        return found
    drawn = [
        rasterize_mesh(surface.vertices, surface.faces, labeled.camera, pose).depth
        for pose in labeled.world_from_camera
    ]
    candidates: list[_Candidate] = []
    for row, near in enumerate(drawn):
        candidates += _candidates(found, masks, labeled, posed, walls, near, row)
    objects, maps, count = list(found.objects), found.id_maps.copy(), 0
    for group in _grouped(candidates):
        wall = walls[group[0].wall]
        box = fit_box(wall, [c.mask for c in group])
        if min(box.size) < config.min_picture_m or max(box.size) > _MAX_SIDE_M:
            continue
        if len({c.row for c in group}) < _AGREED * _visible(box, wall, labeled, drawn):
            continue
        names = {c.name for c in group}
        own = next((k for k, o in enumerate(objects) if o.id in names), len(objects))
        old = objects[own] if own < len(objects) else None
        number = max([*(o.id for o in objects), found.last_id]) + 1 if old is None else old.id
        objects[own : own + 1] = [_instance_on_wall(number, box, wall, old)]
        draw_box(maps, number, box, wall, posed, depth)
        count += 1
    if not count:
        return found
    progress.note(
        f"{count} objects on walls have the size of their masks' outlines: too little of their depth was measured"
    )
    return replace(found, objects=tuple(objects), id_maps=maps)


def _candidates(
    found: InstanceSet, masks: FrameMasks, labeled: FrameMasks, posed: PosedFrames, walls: dict[int, Wall],
    drawn: np.ndarray, row: int,
) -> list[_Candidate]:  # fmt: skip
    """Return the masks of a frame that are surrounded by a wall and have too little surface of their own."""
    ids, names = masks.ids[row], labeled.ids[row]
    pose = np.asarray(labeled.world_from_camera[row], np.float64)
    attached = {o.id: o for o in found.objects if o.attached_hint}
    base = {b.id for b in found.base}
    image = _image_of(posed, int(labeled.frame_indices[row]), labeled)
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
        wall = next((w for w in walls.values() if around[w.id] > _ON_WALL * ring.sum()), None)
        if wall is None:
            continue
        on_wall = WallMask.of(mask, wall, labeled.camera, pose)
        if on_wall is None or not _in_room(on_wall, wall, found):
            continue
        before = (drawn > 0) & (drawn < _BEFORE * wall.depth(labeled.camera, pose)) & mask
        if before.sum() > _HIDDEN_SHARE * area and name not in attached:
            continue
        if name in attached:
            if _has_surface(attached[name], on_wall):
                continue
        elif image is None or not _differs(image, mask, ring & (names == wall.id)):
            continue
        out.append(_Candidate(wall.id, row, name if name in attached else 0, on_wall))
    return out


def _image_of(posed: PosedFrames, index: int, masks: FrameMasks) -> np.ndarray | None:
    """Return the image of a frame in CIELAB at the masks' resolution; None where it is not stored."""
    for indices, images in ((posed.indices, posed.images), (posed.held_out_indices, posed.held_out_images)):
        rows = np.flatnonzero(np.asarray(indices) == index)
        if len(rows) and len(images):
            size = (masks.camera.width, masks.camera.height)
            return lab_from_rgb(cv2.resize(np.asarray(images[rows[0]]), size, interpolation=cv2.INTER_AREA))
    return None


def _differs(lab: np.ndarray, mask: np.ndarray, ring: np.ndarray) -> bool:
    """Return whether the color in a mask differs from that in the ring around it."""
    if not ring.any():
        return False
    ground = np.median(lab[ring] * LIGHTNESS_WEIGHT, axis=0)
    return bool(np.median(np.linalg.norm(lab[mask] * LIGHTNESS_WEIGHT - ground, axis=1)) > _OTHER_COLOR)


def _in_room(mask: WallMask, wall: Wall, found: InstanceSet) -> bool:
    """Return whether a mask on its wall's plane is inside the other planes of the room."""
    corners = wall.points(mask.outline)
    planes = [b.surface.plane for b in found.base if b.id != wall.id and b.observed]
    return all((corners @ p[:3] + p[3] > -_INSIDE_M).mean() >= _INSIDE_SHARE for p in planes)


def _has_surface(item: Instance, mask: WallMask) -> bool:
    """Return whether the box of an object's surface covers most of its mask."""
    return float(np.prod(item.extents_m[1:])) > _OWN_SHARE * _area(mask)


def _area(mask: WallMask) -> float:
    """Return the area of the bounding rectangle of a mask on the wall, m2."""
    return float(np.prod(np.ptp(mask.outline, axis=0)))


def _grouped(candidates: list[_Candidate]) -> list[list[_Candidate]]:
    """Group masks of one object: they overlap on one wall and are of different frames."""
    groups: list[list[_Candidate]] = []
    for candidate in sorted(candidates, key=lambda c: -_area(c.mask)):
        for group in groups:
            same = candidate.wall == group[0].wall and candidate.row not in {c.row for c in group}
            if same and any(_overlap(candidate.mask, c.mask) > _SAME_OVERLAP for c in group):
                group.append(candidate)
                break
        else:
            groups.append([candidate])
    return groups


def _overlap(first: WallMask, second: WallMask) -> float:
    """Return the overlap of two bounding rectangles as a share of the smaller one, which the image border may cut."""
    low = np.maximum(first.outline.min(axis=0), second.outline.min(axis=0))
    high = np.minimum(first.outline.max(axis=0), second.outline.max(axis=0))
    return float(np.prod(np.maximum(high - low, 0.0))) / max(min(_area(first), _area(second)), 1e-9)


def _visible(box: WallBox, wall: Wall, masks: FrameMasks, drawn: list[np.ndarray]) -> int:
    """Return the number of frames that see the center of a box without occlusion."""
    middle = wall.points(np.array([(box.low + box.high) / 2]))[0]
    count = 0
    for pose, near in zip(masks.world_from_camera, drawn):
        local = (middle - pose[:3, 3]) @ pose[:3, :3]
        if local[2] < 0.05:
            continue
        u, v = masks.camera.project(local)
        if 0 <= u < masks.camera.width and 0 <= v < masks.camera.height:
            there = near[int(v), int(u)]
            count += there <= 0 or there > _BEFORE * local[2] - box.front
    return count


def _instance_on_wall(number: int, box: WallBox, wall: Wall, old: Instance | None) -> Instance:
    """Return `old` with this box on its wall, or a new instance."""
    along = (box.low[0] + box.high[0]) / 2
    center = np.array([*(along * wall.along + (0.5 * box.front - wall.offset) * wall.normal)[:2], 0.0])
    center[2] = (box.low[1] + box.high[1]) / 2
    extents = np.array([box.front, *box.size])
    if old is not None:
        return replace(old, center=center, yaw_rad=wall.yaw, extents_m=extents)
    flat = box.front <= MIN_FRONT_M and min(box.size) > 0.2
    label, confidence = ("picture", 0.3) if flat else ("unknown", 0.0)
    return Instance(number, label, confidence, center, wall.yaw, extents, wall.id, True)


def draw_box(
    maps: np.ndarray, number: int, box: WallBox, wall: Wall, posed: PosedFrames, depth: DepthMaps
) -> None:
    """Render a box into the id maps (n, h, w), in place, where no other object and no measured depth is in front."""
    free = np.array([0, wall.id, number])
    for row, pose in enumerate(posed.world_from_camera):
        shape = silhouette(box, wall, depth.camera, np.asarray(pose, np.float64))
        if shape is None:
            continue
        own = shape & np.isin(maps[row], free)
        measured = np.asarray(depth.depth[row])
        own &= ~((measured > 0) & (measured < _BEFORE * wall.depth(depth.camera, pose) - box.front))
        maps[row][own] = number
