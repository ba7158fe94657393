"""The extent of floor, walls and ceiling: rectangles on their planes, completed where no free space forbids it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from reconstruction.core.types import BaseEntity, InstanceSet, ObjectAsset, PosedFrames, SpaceGrid
from registry.geometry import invert_rigid, transform_points

_MARGIN_M = 0.05  # of the floor beyond what was seen
_STOOD_M = 0.3  # of the floor around cameras: whoever filmed stood on it
_LEAST_SIDE_M = 0.1
_BEHIND_M = 0.06  # behind a wall's plane: beyond its own depth noise (`FittedPlane.band_m` is 3.5 cm at most)
_STEP_M = 0.05  # between the points that are looked up in the occupancy grid
_OPEN_SHARE = (
    0.1  # of free space behind a strip above which it is an opening: as for fitted walls (`base_planes`)
)
_PARALLEL_COS = 0.5  # walls whose normals are closer have no corner nearby
_FREE = 1  # state of the occupancy grid


@dataclass(frozen=True)
class Rectangle:
    """A rectangle on the plane of a base entity."""

    entity: BaseEntity
    plane_from_world: np.ndarray  # float64 (4, 4); z along the normal, y up (of level planes: along world y)
    low: np.ndarray  # float64 (2,)
    high: np.ndarray  # float64 (2,)

    @property
    def world_from_plane(self) -> np.ndarray:
        """Return the inverse of `plane_from_world`."""
        return invert_rigid(self.plane_from_world)

    @property
    def normal(self) -> np.ndarray:
        """Return the unit normal (3,), into the room."""
        return self.plane_from_world[2, :3]

    @property
    def middle(self) -> np.ndarray:
        """Return the center (3,) in world space."""
        return self.world((self.low + self.high)[None] / 2)[0]

    def distance(self, point: np.ndarray) -> float:
        """Return the signed distance of a world point (3,) to the plane, positive in the room."""
        return float(self.plane_from_world[2, :3] @ point + self.plane_from_world[2, 3])

    def world(self, flat: np.ndarray, behind_m: float = 0.0) -> np.ndarray:
        """Return world points (n, 3) of in-plane points (n, 2), moved behind the plane."""
        points = np.column_stack([flat, np.full(len(flat), -behind_m)])
        return transform_points(self.world_from_plane, points)


def base_rectangles(
    found: InstanceSet, objects: Sequence[ObjectAsset], posed: PosedFrames, space: SpaceGrid | None
) -> tuple[Rectangle, ...]:
    """Return the rectangle of every base entity.

    The floor extends below all objects and cameras and to the walls. Walls extend down to the floor, behind what hangs
    on them, to their common corners and up to the highest of them or the ceiling, except across openings: strips with
    free space behind them.
    """
    placed = {o.id: transform_points(o.world_from_object, o.visual.vertices) for o in objects}
    floor = next((b for b in found.base if b.label == "floor"), None)
    walls = {b.id: _wall(b, floor, objects, placed) for b in found.base if b.label == "wall"}
    walls = {wall.entity.id: wall for wall in _completed(list(walls.values()), found, space)}
    corners = [w.world(np.array([w.low, w.high])) for w in walls.values()]
    out = []
    for entity in found.base:
        points = [entity.surface.polygon]
        if entity.label == "floor":
            centers = posed.world_from_camera[:, :3, 3]
            points += [*placed.values(), *corners, centers - _STOOD_M, centers + _STOOD_M]
            out.append(_bounding(entity, points, _MARGIN_M))
        elif entity.label == "wall":
            out.append(walls[entity.id])
        else:
            out.append(_bounding(entity, [*points, *corners], 0.0))
    return tuple(out)


def _bounding(entity: BaseEntity, points: list[np.ndarray], margin: float) -> Rectangle:
    """Return the rectangle around points projected onto a base entity's plane."""
    plane_from_world = _plane_frame(entity)
    flat = transform_points(plane_from_world, np.concatenate(points))[:, :2]
    low, high = flat.min(axis=0) - margin, flat.max(axis=0) + margin
    return Rectangle(entity, plane_from_world, low, np.maximum(high, low + _LEAST_SIDE_M))


def _wall(
    entity: BaseEntity, floor: BaseEntity | None, objects: Sequence[ObjectAsset], placed: dict[int, np.ndarray]
) -> Rectangle:  # fmt: skip
    """Return a wall's rectangle: what was seen of it, down to the floor, behind all that hangs on it."""
    points = [entity.surface.polygon]
    if floor is not None:
        points.append(_drop_to(floor, entity.surface.polygon))
        points += [placed[o.id] for o in objects if o.attached_hint and o.support_hint == entity.id]
    return _bounding(entity, points, 0.0)


def _completed(walls: list[Rectangle], found: InstanceSet, space: SpaceGrid | None) -> list[Rectangle]:
    """Extend walls to their corners and to a common height."""
    ceiling = next((b for b in found.base if b.label == "ceiling"), None)
    height = max((float(w.world(w.high[None])[0, 2]) for w in walls), default=0.0)
    if ceiling is not None:
        height = -float(ceiling.surface.plane[3] / ceiling.surface.plane[2])
    out = []
    for wall in walls:
        low, high = wall.low.copy(), wall.high.copy()
        for other in walls:
            if _meets(wall, other) and not any(_is_open(*strip, space) for strip in _gaps(wall, other)):
                at = _crossing(wall, other)
                low[0], high[0] = min(low[0], at), max(high[0], at)
        top = high[1] + max(0.0, height - float(wall.world(high[None])[0, 2]))
        above = np.array([low[0], high[1]]), np.array([high[0], top])
        high = high if _is_open(wall, *above, space) else above[1]
        out.append(replace(wall, low=low, high=high))
    return out


def _meets(wall: Rectangle, other: Rectangle) -> bool:
    """Tell whether two walls have a corner of the room: not parallel, each in front of the other's plane.

    Nor is a wall more than doubled to reach it.
    """
    if wall is other or abs(wall.normal @ other.normal) > _PARALLEL_COS:
        return False
    ahead = wall.distance(other.middle) > 0 and other.distance(wall.middle) > 0
    near = all(high[0] - low[0] <= one.high[0] - one.low[0] for one, low, high in _gaps(wall, other))
    return ahead and near


def _crossing(wall: Rectangle, other: Rectangle) -> float:
    """Return where the plane of another wall crosses a wall, horizontally in its plane."""
    start, end = wall.world(np.array([[0.0, 0.0], [1.0, 0.0]]))
    return -other.distance(start) / float(other.normal @ (end - start))


def _gaps(wall: Rectangle, other: Rectangle) -> list[tuple[Rectangle, np.ndarray, np.ndarray]]:
    """Return the strips (wall, low, high) between two walls and their common corner; none where a wall reaches it."""
    strips = []
    for one, two in ((wall, other), (other, wall)):
        at, low, high = _crossing(one, two), one.low.copy(), one.high.copy()
        if at > high[0]:
            low[0], high[0] = high[0], at
        elif at < low[0]:
            low[0], high[0] = at, low[0]
        else:
            continue
        strips.append((one, low, high))
    return strips


def _is_open(wall: Rectangle, low: np.ndarray, high: np.ndarray, space: SpaceGrid | None) -> bool:
    """Tell whether rays passed through a strip of a wall's plane: free space right behind it."""
    if space is None or (high - low).min() <= 0:
        return False
    sides = [np.arange(a + _STEP_M / 2, b, _STEP_M) for a, b in zip(low, high)]
    if not all(map(len, sides)):
        return False
    flat = np.stack(np.meshgrid(*sides), -1).reshape(-1, 2)
    return bool((space.lookup(wall.world(flat, _BEHIND_M)) == _FREE).mean() > _OPEN_SHARE)


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
