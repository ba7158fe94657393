"""Objects that image borders crop: extrapolation into space that no frame shows.

A side is cropped where its outermost points were seen at the image border and no frame shows anything beyond it.
Equally spaced plates (the boards of a shelf) continue to the next one. Otherwise the last cross-section is repeated
until the object is as long as it is deep: furniture seldom is shorter. A lone upright rectangle on a support is the
front of a box, taken to be as deep as it is wide.

Extrapolation ends at walls, other objects and free space.
"""

from dataclasses import dataclass, replace

import numpy as np

from reconstruction.assets.solid import Solid, box_solid
from reconstruction.assets.views import SeenPoints, pixels_of
from reconstruction.assets.volume import ObjectFrame, ObjectVolume
from reconstruction.core.types import Camera, InstanceSet, PosedFrames, Surface
from registry.geometry import invert_rigid, transform_points

_OUTER_PERCENT = 97.0  # points beyond this percentile along an axis are the outermost
_EDGE_SHARE = 0.04  # of the image's width: the border
_AT_EDGE = 0.5  # least share of the outermost points seen at the border
_BEYOND_SHARE, _BEYOND_MIN_M = 0.04, 0.02  # distance of the probes from a side
_MIN_WITNESSES, _PROBES = 2, 200  # frames, points
_CLEAR = 0.97  # of a probe's depth: what was measured nearer occludes it
_MIN_SIZE_M = 0.25  # smaller objects are not extended
_GAIN_SHARE = 0.08  # smaller extensions are dropped
_SLICES, _DENSE = 40, 0.3  # of an axis; least point density of a well seen slice, relative to the median
_SECTION_SHARE, _MIN_SECTION_M = 0.15, 0.03  # length of the last cross-section
_FACING, _MIN_FACING = 0.8, 100  # least cosine to the axis; points
_PLATE_CELL_M, _PLATE_SHARE, _MIN_PLATES = 0.03, 0.03, 3  # boards at eye level show little of their faces
_PLATE_M = 0.02  # thickness of a plate, of some of which the lower side was seen
_SPACING, _PAST_PLATE = (
    0.15,
    0.2,
)  # greatest relative deviation of gaps; least extent beyond the last plate, in gaps
_SHEET_SHARE = 0.15  # greatest thickness of a lone front, relative to its smaller side
_SHEET_FACING, _SHEET_FILLED, _SHEET_CELLS = (
    0.6,
    0.75,
    12,
)  # share of points facing one way, of cells filled; cells
_STEP_M, _FREE_SHARE, _INSIDE_M = 0.02, 0.3, 0.03  # of the march into free space
_IN_THE_WAY = 5  # surface vertices of another object


@dataclass(frozen=True)
class CutOff:
    """One cropped side of an object, in the grid frame; coordinates are multiplied by `sign`."""

    axis: int
    sign: int  # +1: towards larger coordinates
    cut: float  # it was seen up to here
    end: float  # it is extended to here
    period: float  # length of the part before the cut that is repeated

    def source(self, coordinate: np.ndarray) -> np.ndarray:
        """Return where the content at coordinates beyond the cut is copied from."""
        return coordinate - self.period * np.ceil(np.maximum(coordinate - self.cut, 0.0) / self.period)


@dataclass(frozen=True)
class Room:
    """The surroundings of an object, and the frames that show it."""

    posed: PosedFrames
    camera: Camera  # of the instance maps
    depth: np.ndarray  # float32 (n, h, w) of that camera, metres
    surface: Surface
    found: InstanceSet


def cut_off_sides(item: int, frame: ObjectFrame, seen: SeenPoints, room: Room) -> list[CutOff]:
    """Return the cropped sides of an object and how far each is extended."""
    low, high = np.percentile(frame.points, [0.5, 99.5], axis=0)
    size = high - low
    if frame.wall_y is not None or float(size.max()) < _MIN_SIZE_M:
        return []
    out = []
    for axis, sign in ((2, 1), (0, -1), (0, 1), (1, -1), (1, 1)):
        if not is_cut_off(item, frame, seen, room, axis, sign):
            continue
        side = _continued(frame, axis, sign, size)
        if side is None:
            continue
        end = min(side.end, stopped(item, frame, room, axis, sign, side.cut, side.end))
        if end - side.cut > _GAIN_SHARE * size[axis]:
            out.append(replace(side, end=end))
    return out


def is_cut_off(item: int, frame: ObjectFrame, seen: SeenPoints, room: Room, axis: int, sign: int) -> bool:
    """Tell whether a side was seen at the image border and nothing beyond it."""
    return _at_image_edge(frame, seen, room, axis, sign) and not _seen_beyond(item, frame, room, axis, sign)


def _at_image_edge(frame: ObjectFrame, seen: SeenPoints, room: Room, axis: int, sign: int) -> bool:
    along = sign * (transform_points(invert_rigid(frame.world_from_grid), seen.points))[:, axis]
    own = sign * frame.points[:, axis]
    outer = (along >= np.percentile(own, _OUTER_PERCENT)) & (along <= own.max())
    pose = room.posed.world_from_camera[seen.frames[outer]]
    local = np.einsum("nji,nj->ni", pose[:, :3, :3], seen.points[outer] - pose[:, :3, 3])
    camera = room.camera
    u, v = camera.project(local)
    inward = np.minimum(np.minimum(u, camera.width - u), np.minimum(v, camera.height - v))
    return bool(outer.any() and (inward < _EDGE_SHARE * camera.width).mean() >= _AT_EDGE)


def _seen_beyond(item: int, frame: ObjectFrame, room: Room, axis: int, sign: int) -> bool:
    """Tell whether frames show something else just beyond a side of the object."""
    along = sign * frame.points[:, axis]
    outer = frame.points[along >= np.percentile(along, _OUTER_PERCENT)]
    outer = outer[:: max(1, len(outer) // _PROBES)].copy()
    size = np.ptp(np.percentile(frame.points, [0.5, 99.5], axis=0), axis=0)
    outer[:, axis] = sign * (along.max() + max(_BEYOND_SHARE * float(size.max()), _BEYOND_MIN_M))
    probes = transform_points(frame.world_from_grid, outer)
    witnesses = 0
    for pose, ids, measured in zip(room.posed.world_from_camera, room.found.id_maps, room.depth):
        local = (probes - pose[:3, 3]) @ pose[:3, :3]
        row, column, inside = pixels_of(local, room.camera)
        row, column, z = row[inside], column[inside], local[inside, 2]
        clear = (ids[row, column] != item) & (measured[row, column] > _CLEAR * z)
        witnesses += bool(clear.sum() > 0.5 * len(probes))
        if witnesses >= _MIN_WITNESSES:
            return True
    return False


def _continued(frame: ObjectFrame, axis: int, sign: int, size: np.ndarray) -> CutOff | None:
    """Extend a side to the next of equally spaced plates, or until the object is as long as it is deep."""
    start, cut = _well_seen(sign * frame.points[:, axis])
    plates = _plates(frame, axis, sign)
    if len(plates) >= _MIN_PLATES:
        gaps = np.diff(plates)
        gap = float(np.median(gaps))
        if np.abs(gaps - gap).max() < _SPACING * gap and cut - plates[-1] > _PAST_PLATE * gap:
            return CutOff(axis, sign, cut, float(plates[-1] + gap) + _PLATE_M, gap)
    if axis == 2:
        return None
    period = max(_SECTION_SHARE * (cut - start), _MIN_SECTION_M)
    return CutOff(axis, sign, cut, start + float(size[1 - axis]), period)


def _well_seen(along: np.ndarray) -> tuple[float, float]:
    """Return the first and last coordinate at which points (k,) are about as dense as at the median."""
    low, high = np.percentile(along, [0.5, 99.5])
    count, edges = np.histogram(along, _SLICES, (low, high))
    dense = np.flatnonzero(count >= _DENSE * np.median(count))
    return float(edges[dense[0]]), float(edges[dense[-1] + 1])


def _plates(frame: ObjectFrame, axis: int, sign: int) -> np.ndarray:
    """Return where surfaces that face along an axis lie, ascending, times `sign`: the boards of a shelf."""
    along = sign * frame.points[:, axis]
    low, high = np.percentile(along, [0.5, 99.5])
    facing = np.abs(frame.normals[:, axis]) > _FACING
    if facing.sum() < _MIN_FACING:
        return np.zeros(0)
    count, edges = np.histogram(along[facing], max(int((high - low) / _PLATE_CELL_M), 1), (low, high))
    strong = count >= _PLATE_SHARE * np.sort(count)[-2:].mean()
    starts = np.flatnonzero(strong & ~np.r_[False, strong[:-1]])
    ends = np.flatnonzero(strong & ~np.r_[strong[1:], False])
    middle = 0.5 * (edges[:-1] + edges[1:])
    return np.array([np.average(middle[a : b + 1], weights=count[a : b + 1]) for a, b in zip(starts, ends)])


def stopped(item: int, frame: ObjectFrame, room: Room, axis: int, sign: int, cut: float, end: float) -> float:
    """Return how far, times `sign`, an object can be extended from `cut` to objects, walls or free space."""
    low, high = np.percentile(frame.points, [2, 98], axis=0)
    grid_from_world = invert_rigid(frame.world_from_grid)
    across = [a for a in range(3) if a != axis]
    points = transform_points(grid_from_world, np.asarray(room.surface.vertices, np.float64))
    owner = room.found.vertex_instance
    margin = 0.1 * (high - low)[across]
    within = ((points[:, across] > low[across] + margin) & (points[:, across] < high[across] - margin)).all(1)
    along = sign * points[:, axis]
    other = (
        within
        & (owner > 0)
        & (owner != item)
        & ~np.isin(owner, room.found.static_ids)
        & (along > cut)
        & (along < end)
    )
    if other.sum() >= _IN_THE_WAY:
        end = float(np.percentile(along[other], 5))
    for base in room.found.base:
        normal = float(base.surface.plane[:3] @ frame.world_from_grid[:3, axis] * sign)
        if base.label == "floor" or normal > -0.3:
            continue
        corner = np.array(
            [[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])]
        )
        corner[:, axis] = sign * cut
        world = transform_points(frame.world_from_grid, corner)
        gap = world @ base.surface.plane[:3] + base.surface.plane[3]
        end = min(end, cut + float(np.median(gap)) / -normal)
    return _until_free(frame, room, axis, sign, cut, end)


def _until_free(frame: ObjectFrame, room: Room, axis: int, sign: int, cut: float, end: float) -> float:
    """Return where the space beyond the cut is free, times `sign`, or `end`."""
    points = frame.points - _INSIDE_M * frame.normals
    points = points[:: max(1, len(points) // 2000)]
    points = points[points[:, 2] > 2 * _INSIDE_M].copy()
    if len(points) == 0:
        return end
    for distance in np.arange(cut + 2 * _STEP_M, end, _STEP_M):
        points[:, axis] = sign * distance
        state = room.surface.space.lookup(transform_points(frame.world_from_grid, points))
        if (state == 1).mean() > _FREE_SHARE:
            return float(distance - _STEP_M)
    return end


def lone_front(item: int, frame: ObjectFrame, seen: SeenPoints, room: Room) -> Solid | None:
    """Return the box behind a lone upright rectangle; None for other shapes.

    A cropped rectangle is extended sideways until it is as wide as high.
    """
    low, high = np.percentile(frame.points, [1, 99], axis=0)
    low[2] = min(low[2], 0.0) if frame.on_support else low[2]
    size = high - low
    axis = int(np.argmin(size[:2]))
    wide = 1 - axis
    if frame.wall_y is not None or not frame.on_support or min(size[wide], size[2]) < _MIN_SIZE_M:
        return None
    facing = (np.abs(frame.normals[:, axis]) > _FACING) * np.sign(frame.normals[:, axis])
    behind = -int(np.sign(facing.sum()))
    if size[axis] > _SHEET_SHARE * min(size[wide], size[2]):
        return None
    if abs(facing.sum()) < _SHEET_FACING * len(facing):
        return None
    if not _is_rectangle(frame.points[:, [wide, 2]], low[[wide, 2]], high[[wide, 2]]):
        return None
    front = float(np.median(frame.points[:, axis]))
    low[axis] = high[axis] = front
    missing = size[2] - size[wide]
    for sign in (-1, 1):
        if missing > 0 and is_cut_off(item, frame, seen, room, wide, sign):
            bound = high if sign > 0 else low
            cut = sign * bound[wide]
            bound[wide] = sign * stopped(item, frame, room, wide, sign, cut, cut + missing)
    deep = max(high[wide] - low[wide], size[axis])
    start = behind * front + size[axis]
    back = behind * stopped(item, frame, room, axis, behind, start, behind * front + deep)
    (high if behind > 0 else low)[axis] = back
    return None if abs(back - front) < _SHEET_SHARE * min(size[wide], size[2]) else box_solid(low, high)


def _is_rectangle(across: np.ndarray, low: np.ndarray, high: np.ndarray) -> bool:
    counts = np.histogram2d(*across.T, bins=_SHEET_CELLS, range=np.stack([low, high], 1))[0]
    return bool((counts > 0.2 * np.median(counts)).mean() >= _SHEET_FILLED)


def with_copies(frame: ObjectFrame, sides: list[CutOff]) -> ObjectFrame:
    """Return the frame with points copied to where the object is extended."""
    points, normals = frame.points, frame.normals
    for side in sides:
        along = side.sign * points[:, side.axis]
        kept = along <= side.cut
        parts, directions = [points[kept]], [normals[kept]]
        band = kept & (along > side.cut - side.period)
        for turn in range(1, int(np.ceil((side.end - side.cut) / side.period)) + 1):
            copy = points[band].copy()
            copy[:, side.axis] += side.sign * turn * side.period
            there = side.sign * copy[:, side.axis] <= side.end
            parts.append(copy[there])
            directions.append(normals[band][there])
        points, normals = np.concatenate(parts), np.concatenate(directions)
    return replace(frame, points=points, normals=normals)


def continued(volume: ObjectVolume, sides: list[CutOff]) -> ObjectVolume:
    """Return the volume with the extended sides filled in by copies, except where space is known to be free."""
    for side in sides:
        along = side.sign * volume.centers(side.axis)
        beyond = np.flatnonzero((along > side.cut) & (along <= side.end))
        source = side.source(along[beyond])
        position = (side.sign * source - volume.origin[side.axis]) / volume.voxel_m - 0.5
        nearest = np.clip(np.round(position).astype(int), 0, volume.distance.shape[side.axis] - 1)
        fields = {}
        views = {
            name: np.moveaxis(getattr(volume, name).copy(), side.axis, 0)
            for name in ("distance", "known", "free")
        }
        keep = views["free"][beyond] & views["known"][beyond]
        for name, view in views.items():
            view[beyond] = np.where(keep, view[beyond], view[nearest])
            fields[name] = np.ascontiguousarray(np.moveaxis(view, 0, side.axis))
        volume = replace(volume, **fields)
    return volume
