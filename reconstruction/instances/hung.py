"""Flat things on walls that have no surface of their own: found in pictures of the walls.

A picture in the corner of a few frames is within the noise of depth, or has none. But cameras and the wall's plane are
known well: keyframes laid onto it agree on what is painted there and what hangs there.
"""

from dataclasses import replace

import cv2
import numpy as np

from reconstruction.instances.config import InstancesConfig
from reconstruction.instances.outlined import draw_box, instance_on_wall
from reconstruction.instances.outlined_box import Wall, WallBox, Window, agreement, fit_box
from reconstruction.instances.wall_pictures import WallPicture, smooth
from reconstruction.instances.wall_regions import MIN_SIDE_M, Ground, Region, apart, core, find_regions
from reconstruction.progress import Progress
from reconstruction.types import DepthMaps, Instance, InstanceSet, PosedFrames, Surface

_MAX_SIDE_M = 2.5
_MAX_FRAMES = 14
_AROUND_M = 0.4  # of a region, where a frame may show it if it stands out from the wall
_COMMON, _AGREED = 0.3, 0.5  # of a region, by a frame; of the frames that see its place
_WHOLE = 0.7  # of its place must be in a frame's view to judge
_LIKE_OUTLINES = 0.6  # mean IoU
_DEEP_M, _SHELF = 0.1, 2.0  # what stands out farther is a shelf: so much wider than high
_SAME, _ENOUGH = 0.4, 0.6  # of the smaller rectangle on the wall; of the outline's area
_THROUGH, _NEAR_M = 0.6, 0.03  # of a piece's width; between a board and what carries it
_MANY, _ALIKE = 5, 0.15  # regions of one size: a pattern


def add_hung(
    found: InstanceSet, posed: PosedFrames, depth: DepthMaps, surface: Surface, config: InstancesConfig,
    progress: Progress,
) -> InstanceSet:  # fmt: skip
    """Return the instances with what hangs on walls and shows in the walls' pictures only.

    Args:
        found: what has surface.
        posed: keyframes in world space.
        depth: their depth in metres.
        surface: what was cut.
        config: how far a color must be from the wall's.
        progress: told of what was found.
    """
    count = 0
    for wall in [Wall.of(b) for b in found.base if b.label == "wall" and b.observed]:
        picture = WallPicture.of(wall, found, posed, depth, np.asarray(surface.vertices))
        if picture is None:
            continue
        ground, regions = find_regions(picture, config)
        boxes = [
            box for region in regions if (box := _box(region, ground, picture, posed, depth)) is not None
        ]
        boxes = _without_patterns(boxes) + [
            box for region in regions if region.slim and (box := _joined(region, picture, found)) is not None
        ]
        for box in boxes:
            renewed = _with_box(found, box, wall, posed, depth, surface)
            count += renewed is not found
            found = renewed
    if count:
        progress.note(
            f"{count} flat things on walls are known by the walls' pictures: depth shows too little of them"
        )
    return found


def _box(
    region: Region, ground: Ground, picture: WallPicture, posed: PosedFrames, depth: DepthMaps
) -> WallBox | None:
    """Return the box of a region by its outlines in the frames that show it, None where they do not agree."""
    margin = round(_AROUND_M / picture.cell_m)
    rows, columns = np.nonzero(region.mask)
    where = np.s_[
        max(rows.min() - margin, 0) : rows.max() + margin,
        max(columns.min() - margin, 0) : columns.max() + margin,
    ]
    inside = region.mask[where]
    views = [
        k
        for k in range(len(picture.rows))
        if (picture.valid[k][where] & inside).sum() > _WHOLE * inside.sum()
    ]
    if len(views) < 2:
        return None
    views = [
        views[k]
        for k in np.unique(np.linspace(0, len(views) - 1, min(len(views), _MAX_FRAMES)).round().astype(int))
    ]
    shown = [
        (k, mask) for k in views if (mask := _shown(k, region, inside, ground, picture, where)) is not None
    ]
    if len(shown) < max(2, _AGREED * len(views)):
        return None
    if not region.slim:
        shown = [(k, core(mask)) for k, mask in shown]
    windows = _windows(shown, picture, where, posed, depth)
    if len(windows) < 2:
        return None
    box = fit_box(picture.wall, windows)
    if np.mean([agreement(box, picture.wall, w) for w in windows]) < _LIKE_OUTLINES:
        return None
    if box.front > _DEEP_M and box.size[0] < _SHELF * box.size[1]:
        return None  # it stands before the wall
    return box if min(box.size) >= MIN_SIDE_M and max(box.size) <= _MAX_SIDE_M else None


def _joined(region: Region, picture: WallPicture, found: InstanceSet) -> WallBox | None:
    """Return the box of pieces that a board goes through, None where it goes through none or one."""
    rows, columns = np.nonzero(region.mask)
    along = picture.low + picture.cell_m * np.array([columns.min(), columns.max() + 1])
    height = picture.top - picture.cell_m * np.array([rows.max() + 1, rows.min()])
    pieces = []
    for item in found.objects:
        if not item.attached_hint or item.support_hint != picture.wall.id:
            continue
        low, high = _rectangle(item, picture.wall)
        within = min(high[0], along[1]) - max(low[0], along[0])
        if (
            within > _THROUGH * (high[0] - low[0])
            and low[1] < height[1] + _NEAR_M
            and high[1] > height[0] - _NEAR_M
        ):
            pieces.append((low, high, float(item.extents_m[0])))
    if len(pieces) < 2:
        return None
    low, high = np.min([p[0] for p in pieces], axis=0), np.max([p[1] for p in pieces], axis=0)
    if high[1] - low[1] > (high[0] - low[0]) / _SHELF:
        return None
    return WallBox(low, high, max(p[2] for p in pieces))


def _shown(
    k: int,
    region: Region,
    inside: np.ndarray,
    ground: Ground,
    picture: WallPicture,
    where: tuple[slice, slice],
) -> np.ndarray | None:
    """Return what one frame shows at a region's place, bool of that part of the wall; None for nothing."""
    valid = picture.valid[k][where]
    lab = smooth(picture.frames[k][where], valid)
    mask = apart(lab, valid, ground, picture.cell_m, where, shaded=region.shaded).astype(np.uint8)
    _, labels = cv2.connectedComponents(mask)
    common = np.bincount(labels[inside])
    common[0] = 0
    best = int(np.argmax(common))
    return labels == best if best and common[best] > _COMMON * inside.sum() else None


def _windows(
    shown: list[tuple[int, np.ndarray]], picture: WallPicture, where: tuple[slice, slice], posed: PosedFrames,
    depth: DepthMaps,
) -> list[Window]:  # fmt: skip
    """Return masks on the wall as their frames show them."""
    size = (depth.camera.width, depth.camera.height)
    out = []
    for k, mask in shown:
        row = int(picture.rows[k])
        whole = np.zeros(picture.hidden.shape, np.uint8)
        whole[where] = mask
        pixels = cv2.warpPerspective(
            whole, picture.into_camera(row, posed, depth.camera), size, flags=cv2.INTER_NEAREST
        )
        window = Window.of(
            pixels > 0, picture.wall, depth.camera, np.asarray(posed.world_from_camera[row], np.float64)
        )
        if window is not None:
            out.append(window)
    return out


def _without_patterns(boxes: list[WallBox]) -> list[WallBox]:
    """Leave out boxes of which there are many of one size: a wallpaper's."""

    def alike(box: WallBox) -> int:
        return sum(bool((np.abs(o.size - box.size) < _ALIKE * box.size).all()) for o in boxes)

    return [box for box in boxes if alike(box) < _MANY]


def _with_box(
    found: InstanceSet, box: WallBox, wall: Wall, posed: PosedFrames, depth: DepthMaps, surface: Surface
) -> InstanceSet:
    """Return the instances with a thing of this box; its pieces, if there are any, become one."""
    same = sorted((o for o in found.objects if _overlap(o, box, wall) > _SAME), key=lambda o: -_area(o))
    if len(same) == 1 and _area(same[0]) > _ENOUGH * float(np.prod(box.size)):
        return found
    own = same[0] if same else None
    number = own.id if own is not None else max([*(o.id for o in found.objects), len(found.base)]) + 1
    gone = [o.id for o in same[1:]]
    vertices, maps = found.vertex_instance.copy(), found.id_maps.copy()
    vertices[np.isin(vertices, gone)] = number
    maps[np.isin(maps, gone)] = number
    objects = [
        instance_on_wall(number, box, wall, o) if o.id == number
        else replace(o, support_hint=number) if o.support_hint in gone else o
        for o in found.objects if o.id not in gone
    ]  # fmt: skip
    if own is None:
        objects.append(instance_on_wall(number, box, wall, None))
    out = replace(found, objects=tuple(objects), id_maps=maps, vertex_instance=vertices)
    draw_box(maps, number, box, wall, posed, depth, surface, out)
    return out


def _overlap(item: Instance, box: WallBox, wall: Wall) -> float:
    """Return the common area of a thing on this wall and a box, of the smaller one; 0 for what hangs elsewhere."""
    if not item.attached_hint or item.support_hint != wall.id:
        return 0.0
    low, high = _rectangle(item, wall)
    common = np.maximum(np.minimum(high, box.high) - np.maximum(low, box.low), 0.0)
    return float(np.prod(common)) / max(min(_area(item), float(np.prod(box.size))), 1e-9)


def _rectangle(item: Instance, wall: Wall) -> tuple[np.ndarray, np.ndarray]:
    middle = np.array([item.center @ wall.along, item.center[2]])
    return middle - 0.5 * item.extents_m[1:], middle + 0.5 * item.extents_m[1:]


def _area(item: Instance) -> float:
    return float(np.prod(item.extents_m[1:]))
