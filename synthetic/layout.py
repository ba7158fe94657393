"""Where the things of a procedural room go: rejection sampling with real footprints, nothing overlaps.

World space: metres, +z up, floor at z = 0, the middle group of tables around the origin. The camera walks around
it on a band that stays free (`RoomShape.walk`); other furniture stands between that band and the walls.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from registry.geometry import invert_rigid, rigid, transform_points
from synthetic import footprints as plane
from synthetic.containers import CONTAINER_KINDS, VESSEL_KINDS, make_crate
from synthetic.furnishing import CENTER_KINDS, SIDE_KINDS, WALL_KINDS
from synthetic.furniture import Workshop
from synthetic.furniture_families import CLOTH_KINDS, hang_range_m, kind_named
from synthetic.room import WALL_HEIGHT_M
from synthetic.shapes import COARSE
from synthetic.things import SMALL_KINDS, Kind, Place, Thing

KINDS: dict[str, Kind] = {
    **CENTER_KINDS, **SIDE_KINDS, **WALL_KINDS, **CONTAINER_KINDS, **VESSEL_KINDS, **SMALL_KINDS,
    "crate": Kind("crate", make_crate, weight=0.8),
}  # fmt: skip
"""What a household room holds; more comes from families (`kind_of`)."""

_WALK_AWAY_M = 0.78  # of the camera from the middle group, as a person stands at a table
_WALK_HALF_M = 0.36  # half the width of the band that stays free
_ZONE_M = 0.52  # between the band and the walls
_WALL_YAW = {"wall_north": 0.0, "wall_west": np.pi / 2, "wall_south": np.pi, "wall_east": -np.pi / 2}
_EDGE_M, _IN_CONTAINER_M, _ABOVE_M = 0.012, 0.008, 0.01
_TRIES = 60
_LIKED = {"board": 4.0}  # wall shelves are small, but nobody hangs one to leave it empty


def kind_of(key: str) -> Kind:
    """Return a kind by its name in rooms: of a household, or of a family."""
    kind = KINDS.get(key)
    return kind_named(key) if kind is None else kind


class RoomIsFull(Exception):
    """This attempt found no place for a thing; the next attempt starts afresh."""


_DIRECTIONS = np.stack([np.cos(np.arange(40) * np.pi / 20), np.sin(np.arange(40) * np.pi / 20)])


def few_corners(points: np.ndarray) -> np.ndarray:
    """Return the convex hull of many points by its corners in 40 directions; half a percent of its size is lost."""
    if len(points) > 60:
        points = points[np.unique(np.argmax(points @ _DIRECTIONS, axis=0))]
    return plane.convex_hull(points)


def _far(a: np.ndarray, b: np.ndarray, gap: float) -> bool:
    """Tell quickly that two polygons are farther apart than a gap: their bounding boxes are."""
    return bool(max((b.min(0) - a.max(0)).max(), (a.min(0) - b.max(0)).max()) >= gap + 1e-9)


@dataclass(frozen=True)
class RoomShape:
    """Walls and the way of the camera."""

    west: float
    east: float
    south: float
    north: float
    walls: tuple[str, ...]
    half: tuple[float, float]  # semi-axes of the walk around the origin
    facing_rad: float = 0.0  # turns the walk: 0 comes from the south (-y), positive from further east
    free_deg: tuple[float, float] = (-180.0, 180.0)  # angles of the walk that stay free, before `facing_rad`
    wall_height_m: float = WALL_HEIGHT_M
    surface_m: float = 0.5  # height of the main support, where the camera should look
    layout: str = "walk_around"

    def walk(self, angle_rad: np.ndarray, outwards_m: float = 0.0) -> np.ndarray:
        """Return points (n, 2) of the walk, a rounded rectangle, at these angles seen from the middle."""
        c, s = np.cos(angle_rad + self.facing_rad), np.sin(angle_rad + self.facing_rad)
        a, b = self.half[0] + outwards_m, self.half[1] + outwards_m
        radius = (np.abs(c / a) ** 2.4 + np.abs(s / b) ** 2.4) ** (-1 / 2.4)
        return np.stack([radius * c, radius * s], -1)

    def wall(self, name: str) -> tuple[np.ndarray, float]:
        """Return the middle (2,) of a wall's face at the floor and its length."""
        middle = np.array([(self.west + self.east) / 2, (self.south + self.north) / 2])
        wide, deep = self.east - self.west, self.north - self.south
        return {
            "wall_north": (np.array([middle[0], self.north]), wide),
            "wall_south": (np.array([middle[0], self.south]), wide),
            "wall_west": (np.array([self.west, middle[1]]), deep),
            "wall_east": (np.array([self.east, middle[1]]), deep),
        }[name]


@dataclass
class Item:
    """A placed thing."""

    name: str
    key: str  # of `KINDS`
    stream: tuple[int, ...]  # seeds the random numbers that its maker draws from
    model: Thing  # coarse
    parent: "Item | None"
    support: str  # name of its parent: a thing, the floor or a wall
    pose: np.ndarray  # world_from_object (4, 4)
    silhouette: np.ndarray  # world (k, 2)
    bottom_m: float
    top_m: float
    ceiling_m: float = np.inf  # world height that nothing on it may reach, in a compartment
    level: int = 0  # 1 on furniture, 2 on that, ...; 0 for furniture
    hangs: bool = False
    contact: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))  # world (k, 2)
    mass: tuple[float, np.ndarray] = (0.0, np.zeros(3))  # volume in m3, its middle in the world
    children: list[tuple["Item", Place]] = field(default_factory=list)
    bodies: tuple[
        tuple[np.ndarray, float, float], ...
    ] = ()  # (silhouette, bottom, top) of parts; (): the whole
    near: bool = False  # main furniture, where most things go

    def solids(self) -> tuple[tuple[np.ndarray, float, float], ...]:
        """Return the silhouettes and the world heights that other things must keep clear of."""
        return self.bodies or ((self.silhouette, self.bottom_m, self.top_m),)

    def ancestors(self) -> list["Item"]:
        """Return what it stands on, from near to far."""
        out, item = [], self.parent
        while item is not None:
            out.append(item)
            item = item.parent
        return out


@dataclass(frozen=True)
class Shape:
    """What layout needs to know of a model."""

    model: Thing
    silhouette: np.ndarray  # object space (k, 2)
    foot: np.ndarray  # object space (k, 2)
    low: np.ndarray  # (3,) of its bounding box
    high: np.ndarray
    volume: float
    center: np.ndarray  # (3,) of mass

    @classmethod
    def of(cls, model: Thing, hull: Callable[[np.ndarray], np.ndarray] = plane.convex_hull) -> "Shape":
        """Measure a coarse model."""
        points = np.concatenate([p.vertices for part in model.parts for p in part])
        corners = np.concatenate([p.vertices[p.faces] for part in model.parts for p in part])
        volume = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
        if volume.sum() > 1e-9:
            center = (volume[:, None] * corners.sum(1) / 4).sum(0) / volume.sum()
        else:  # a model of sheets
            center = points.mean(0)
        silhouette = hull(points[:, :2])
        foot = hull(points[points[:, 2] < points[:, 2].min() + 1e-6, :2])
        if len(foot) < 3 or plane.area(foot) < 1e-6:  # it touches in a point or along a line
            foot = silhouette.mean(0) + 0.4 * (silhouette - silhouette.mean(0))
        low, high = points.min(0), points.max(0)
        return cls(model, silhouette, foot, low, high, float(volume.sum()), center)

    def bodies(self, pose: np.ndarray) -> tuple[tuple[np.ndarray, float, float], ...]:
        """Return silhouette, bottom and top of every part in the world."""
        yaw, z = np.arctan2(pose[1, 0], pose[0, 0]), float(pose[2, 3])
        return tuple(
            (plane.turned(outline, yaw, *pose[:2, 3]), z + low, z + high)
            for outline, low, high in self._parts
        )  # fmt: skip

    @cached_property
    def _parts(self) -> list[tuple[np.ndarray, float, float]]:
        points = [np.concatenate([p.vertices for p in part]) for part in self.model.parts]
        return [(few_corners(p[:, :2]), float(p[:, 2].min()), float(p[:, 2].max())) for p in points]


class Layout:
    """A room while it is being filled."""

    def __init__(self, seed: tuple[int, ...], max_stack: int, gap_m: float, crowding: float) -> None:
        """Start with an empty room; every draw depends on `seed` only."""
        self.rng = np.random.default_rng(seed)
        self.seed, self.max_stack, self.gap_m, self.crowding = seed, max_stack, gap_m, crowding
        self.items: list[Item] = []
        self.shape: RoomShape | None = None
        self.near_weight = 2.0  # of main furniture where things are put
        self._drawn = 0
        self._counts: dict[str, int] = {}

    def draw(self, keys: Iterable[str]) -> tuple[str, tuple[int, ...], Shape]:
        """Draw a kind, rather one that is not in the room yet, and make its coarse model."""
        keys = list(keys)
        weights = np.array([kind_of(k).weight * 0.4 ** self._counts.get(k, 0) for k in keys])
        key = keys[int(self.rng.choice(len(keys), p=weights / weights.sum()))]
        self._drawn += 1
        stream = (*self.seed, self._drawn)
        coarse = kind_of(key).make(Workshop(np.random.default_rng(stream), COARSE, 0.01), "")
        return key, stream, Shape.of(coarse) if key in KINDS else Shape.of(coarse, few_corners)

    def _add(self, key, stream, shape: Shape, parent, support, pose, **more) -> Item:
        self._counts[key] = self._counts.get(key, 0) + 1
        yaw = np.arctan2(pose[1, 0], pose[0, 0])
        outline = plane.turned(shape.silhouette, yaw, *pose[:2, 3])
        item = Item(
            f"{key}_{self._counts[key]}", key, stream, shape.model, parent, support, pose, outline,
            pose[2, 3] + shape.low[2], pose[2, 3] + shape.high[2],
            mass=(shape.volume, pose[:3, :3] @ shape.center + pose[:3, 3]), **more,
        )  # fmt: skip
        self.items.append(item)
        return item

    # Furniture

    def furnish_middle(self, count: int, walls: tuple[str, ...]) -> None:
        """Put tables side by side around the origin; this decides the size of the room."""
        drawn = [self.draw(CENTER_KINDS if count == 1 else ["table"]) for _ in range(count)]
        widths = [float(np.ptp(shape.silhouette[:, 0])) for *_, shape in drawn]
        gap = 0.1
        x = -(sum(widths) + gap * (count - 1)) / 2
        for (key, stream, shape), width in zip(drawn, widths):
            yaw = np.radians(self.rng.uniform(-6, 6)) if count == 1 else 0.0
            self._add(key, stream, shape, None, "floor", _upright(yaw, x + width / 2, 0.0, 0.0))
            x += width + gap
        reach = np.abs(np.concatenate([i.silhouette for i in self.items])).max(0)
        half = (float(reach[0]) + _WALK_AWAY_M, float(reach[1]) + _WALK_AWAY_M)
        aside = _WALK_HALF_M + _ZONE_M
        east, north = half[0] + aside, half[1] + aside
        south = -north if "wall_south" in walls else -(half[1] + 0.7)
        self.shape = RoomShape(-east, east, south, north, walls, half)

    def stand(
        self, drawn: tuple[str, tuple[int, ...], Shape], yaw: float, x: float, y: float, **more
    ) -> Item:
        """Stand a drawn piece on the floor at a chosen place."""
        key, stream, shape = drawn
        pose = _upright(yaw, x, y, 0.0)
        return self._add(key, stream, shape, None, "floor", pose, bodies=shape.bodies(pose), **more)

    def may_stand(self, shape: Shape, yaw: float, x: float, y: float, gap_m: float = 0.03) -> bool:
        """Check that a piece stays in the room, off the camera's way and clear of what stands there."""
        room = self._room()
        outline = plane.turned(shape.silhouette, yaw, x, y)
        if np.any(outline.min(0) < (room.west, room.south)) or np.any(
            outline.max(0) > (room.east, room.north)
        ):
            return False
        return self._off_the_walk(outline) and self.is_clear(shape.bodies(_upright(yaw, x, y, 0.0)), gap_m)

    def is_clear(self, bodies: tuple[tuple[np.ndarray, float, float], ...], gap_m: float) -> bool:
        """Check parts of a piece against all furniture, part by part."""
        for outline, bottom, top in bodies:
            for other in self.items:
                if bottom > other.top_m or top < other.bottom_m or _far(outline, other.silhouette, gap_m):
                    continue
                if plane.distance(outline, other.silhouette) >= gap_m:
                    continue
                for theirs, low, high in other.solids():
                    if bottom >= high + 0.01 or low >= top + 0.01 or _far(outline, theirs, gap_m):
                        continue
                    if plane.distance(outline, theirs) < gap_m:
                        return False
        return True

    def _off_the_walk(self, outline: np.ndarray) -> bool:
        """Check an outline against the band where the camera goes."""
        room = self._room()
        low, high = np.radians(room.free_deg)
        ways = room.walk(np.linspace(low, high, 60))
        steps = np.roll(outline, -1, axis=0) - outline
        away = ways[:, None] - outline
        share = np.clip(np.sum(away * steps, -1) / np.maximum(np.sum(steps**2, -1), 1e-12), 0, 1)
        gap = np.linalg.norm(away - share[..., None] * steps, axis=-1).min()
        inside = (steps[:, 0] * away[..., 1] - steps[:, 1] * away[..., 0] > 0).all(1).any()
        return bool(gap > min(_WALK_HALF_M, 0.6 * min(room.half)) and not inside)

    def furnish_side(self, keys: Iterable[str], walls: tuple[str, ...] = ()) -> None:
        """Stand a piece with its back to a wall, off the camera's way."""
        shape_of_room = self._room()
        turned = shape_of_room.free_deg != (-180.0, 180.0)
        among = walls or shape_of_room.walls
        angles = np.linspace(0, 2 * np.pi, 48, endpoint=False)
        band = plane.convex_hull(shape_of_room.walk(angles, _WALK_HALF_M))
        key, stream, shape = self.draw(keys)
        for _ in range(4 * _TRIES):
            wall = among[int(self.rng.integers(len(among)))]
            loose = key.rsplit("_", 1)[-1] in ("stool", "chair", "crate", "pouf")
            spread = np.radians(20.0 if loose else 2.0)
            yaw = _WALL_YAW[wall] + self.rng.uniform(-spread, spread)
            middle, length = shape_of_room.wall(wall)
            along = np.array([np.cos(_WALL_YAW[wall]), np.sin(_WALL_YAW[wall])])
            outline = plane.turned(shape.silhouette, yaw)
            inwards = np.array([along[1], -along[0]])
            back = float((outline @ -inwards).max()) + self.rng.uniform(0.02, 0.05)
            at = middle + inwards * back + along * self.rng.uniform(-0.5, 0.5) * length
            outline = outline + at
            if not self._in_room(outline, at):
                continue
            if not self._off_the_walk(outline) if turned else plane.distance(outline, band) < 0:
                continue
            if all(
                plane.distance(outline, other.silhouette) > 0.1 or other.bottom_m > shape.high[2] + 0.1
                for other in self.items
            ):
                self._add(key, stream, shape, None, "floor", _upright(yaw, *at, 0.0))
                return
        raise RoomIsFull(key)

    def _room(self) -> RoomShape:
        assert self.shape is not None, "the middle group decides the room's shape and comes first"
        return self.shape

    def _in_room(self, outline: np.ndarray, at: np.ndarray) -> bool:
        room = self._room()
        inside = np.array([room.west, room.south]) + 0.015 < outline.min(0)
        inside &= outline.max(0) < np.array([room.east, room.north]) - 0.015
        # An open side is where the camera comes from: what stands beside it would never be seen.
        return bool(inside.all()) and ("wall_south" in room.walls or at[1] > -0.35 * room.half[1])

    def hang_at(
        self, drawn: tuple[str, tuple[int, ...], Shape], wall: str, x: float, y: float, z: float
    ) -> Item:
        """Hang a drawn thing on a wall at a chosen place."""
        key, stream, shape = drawn
        return self._add(
            key, stream, shape, None, wall, _upright(_WALL_YAW[wall], x, y, z), hangs=True, bodies=()
        )

    def hang(self, keys: Iterable[str]) -> None:
        """Hang a thing on a wall, clear of what stands below."""
        room = self._room()
        key, stream, shape = self.draw(keys)
        low_high = hang_range_m(key)
        if low_high is not None:
            self._hang_family((key, stream, shape), low_high)
            return
        high = 0.92 if key == "wall_shelf" else 0.86
        for _ in range(4 * _TRIES):
            wall = room.walls[int(self.rng.integers(len(room.walls)))]
            middle, length = room.wall(wall)
            yaw = _WALL_YAW[wall]
            along = np.array([np.cos(yaw), np.sin(yaw)])
            at = middle + along * self.rng.uniform(-0.5, 0.5) * (
                length - np.ptp(shape.silhouette[:, 0]) - 0.5
            )
            z = float(self.rng.uniform(high, high + 0.35))
            if "wall_south" not in room.walls and at[1] < -0.35 * room.half[1]:
                continue
            outline = plane.turned(shape.silhouette, yaw, *at)
            clear = all(
                plane.distance(outline, o.silhouette) > 0.1 or (z > o.top_m + 0.28 and not o.hangs)
                for o in self.items
            )
            if clear:
                self._add(key, stream, shape, None, wall, _upright(yaw, *at, z), hangs=True)
                return
        raise RoomIsFull(key)

    def _hang_family(
        self, drawn: tuple[str, tuple[int, ...], Shape], low_high: tuple[float, float]
    ) -> None:  # fmt: skip
        """Hang a thing at the height that its kind asks for, clear of what stands in front or hangs there."""
        room, shape = self._room(), drawn[2]
        top = room.wall_height_m - float(shape.high[2]) - 0.01
        low, high = (min(v, top) for v in low_high)
        if top < 0:
            raise RoomIsFull(drawn[0])
        half = float(np.abs(shape.silhouette[:, 0]).max())
        for _ in range(3 * _TRIES):
            wall = room.walls[int(self.rng.integers(len(room.walls)))]
            middle, length = room.wall(wall)
            along = np.array([np.cos(_WALL_YAW[wall]), np.sin(_WALL_YAW[wall])])
            reach = length / 2 - half - 0.05
            at = middle + along * self.rng.uniform(-1, 1) * max(reach, 0.0)
            z = float(self.rng.uniform(low, high)) if high > low else low
            if reach < 0 or ("wall_south" not in room.walls and at[1] < -0.35 * room.half[1]):
                continue
            outline = plane.turned(shape.silhouette, _WALL_YAW[wall], *at)
            end = z + float(shape.high[2])
            clear = all(
                plane.distance(outline, o.silhouette) > 0.06
                or (not o.hangs and z > o.top_m + 0.2)
                or (o.hangs and (z > o.top_m + 0.06 or end < o.bottom_m - 0.06))
                for o in self.items
            )
            if clear and (low > 0.7 or self._off_the_walk(outline)):
                self.hang_at(drawn, wall, *at, z)
                return
        raise RoomIsFull(drawn[0])

    # Things

    def lay_cloth(self) -> bool:
        """Lay a cloth on a free level support; False where none fits."""
        options = [
            (item, place) for item, place, _ in self.open_places()
            if place.sag is None and not np.isfinite(place.headroom_m) and plane.area(place.area) > 0.12
            and not any(p is place for _, p in item.children)
        ]  # fmt: skip
        if not options:
            return False
        weights = np.array([plane.area(p.area) * (3.0 if i.near else 1.0) for i, p in options])
        owner, place = options[int(self.rng.choice(len(options), p=weights / weights.sum()))]
        for key in CLOTH_KINDS:
            for _ in range(3):
                key, stream, shape = self.draw([key])
                for _ in range(12):
                    yaw = 0.5 * np.pi * int(self.rng.integers(2)) + np.radians(self.rng.uniform(-8, 8))
                    outline = plane.turned(shape.silhouette, yaw)
                    low, high = place.area.min(0) - outline.min(0), place.area.max(0) - outline.max(0)
                    x, y = self.rng.uniform(np.minimum(low, high), np.maximum(low, high))
                    outline = outline + np.array([x, y])
                    if plane.depth_inside(outline, place.area) < 0.003:
                        continue
                    pose = owner.pose @ _upright(yaw, x, y, place.height_m)
                    item = self._add(
                        key, stream, shape, owner, owner.name, pose, level=0, contact=outline,
                        ceiling_m=owner.ceiling_m, near=owner.near,
                    )  # fmt: skip
                    owner.children.append((item, place))
                    return True
        return False

    def put(
        self, keys: Iterable[str], places: Callable[[], list[tuple[Item, Place, float]]], kinds_tried: int = 6
    ) -> Item:
        """Put a thing of one of these kinds somewhere in `places()`: (owner, place, weight)."""
        keys = list(keys)
        for _ in range(kinds_tried):
            key, stream, shape = self.draw(keys)
            options = places()
            if not options:
                break
            weights = np.array([w for *_, w in options], float)
            for _ in range(_TRIES):
                owner, place, _ = options[int(self.rng.choice(len(options), p=weights / weights.sum()))]
                found = self._try(shape, owner, place)
                if found is not None:
                    pose, contact = found
                    item = self._add(
                        key, stream, shape, owner, owner.name, pose, level=owner.level + 1, contact=contact,
                        ceiling_m=min(owner.ceiling_m, float(pose[2, 3]) + place.headroom_m),
                    )  # fmt: skip
                    owner.children.append((item, place))
                    return item
        raise RoomIsFull(", ".join(keys))

    def _try(self, shape: Shape, owner: Item, place: Place) -> tuple[np.ndarray, np.ndarray] | None:
        """Drop a thing at random on a place; (pose, contact) where it may stay."""
        height = float(shape.high[2])
        bottom = float(owner.pose[2, 3]) + place.height_m + _lowest(place)
        headroom = min(place.headroom_m, owner.ceiling_m - bottom)
        if height + _ABOVE_M > headroom or (place.inside and height > place.rim_m + 0.17):
            return None
        yaw = self.rng.uniform(0, 2 * np.pi)
        low, high = place.area.min(0), place.area.max(0)
        x, y = self.rng.uniform(low, high)
        if place.stack:  # stacks are built with a little care
            x, y = place.area.mean(0) + 0.35 * (np.array([x, y]) - place.area.mean(0))
        elif self.crowding > 0 and not place.inside:
            x, y = self._beside(shape, owner, place, (x, y))
        outline = plane.turned(shape.silhouette, yaw, x, y)
        margin = _IN_CONTAINER_M if place.rim_m > 0 else _EDGE_M
        overhangs = place.stack and place.rim_m == 0
        if not overhangs and plane.depth_inside(outline, place.area) < margin:
            return None
        lift = (
            0.0
            if place.sag is None
            else _rest_height(place, plane.turned(shape.foot, yaw, x, y), shape.model)
        )
        pose = owner.pose @ _upright(yaw, x, y, place.height_m + lift)
        turn = np.arctan2(pose[1, 0], pose[0, 0])
        world = plane.turned(shape.silhouette, turn, *pose[:2, 3])
        foot = plane.turned(shape.foot, turn, *pose[:2, 3])
        contact = foot
        if place.stack:
            owner_turn = np.arctan2(owner.pose[1, 0], owner.pose[0, 0])
            top = plane.turned(place.area, owner_turn, *owner.pose[:2, 3])
            contact = plane.intersection(foot, top)
            center = pose[:3, :3] @ shape.center + pose[:3, 3]
            if plane.area(contact) < 0.75 * plane.area(foot) or not self._stands(
                owner, shape, center, contact
            ):
                return None
        gap = min(self.gap_m, 0.012) if place.inside else self.gap_m
        if not self._is_free(world, bottom, bottom + height, owner, gap):
            return None
        return pose, contact

    def _beside(
        self, shape: Shape, owner: Item, place: Place, at: tuple[float, float]
    ) -> tuple[float, float]:
        """Return a point close to a thing that stands there already, as often as `crowding` says."""
        neighbors = [c for c, p in owner.children if p is place]
        if not neighbors or self.rng.random() > self.crowding:
            return at
        other = neighbors[int(self.rng.integers(len(neighbors)))]
        reach = np.sqrt(plane.area(shape.silhouette) / np.pi) + np.sqrt(plane.area(other.silhouette) / np.pi)
        away = reach + self.gap_m + self.rng.uniform(0.0, 0.03)
        turn = self.rng.uniform(0, 2 * np.pi)
        middle = transform_points(invert_rigid(owner.pose), other.pose[None, :3, 3])[0]
        return float(middle[0] + away * np.cos(turn)), float(middle[1] + away * np.sin(turn))

    def _stands(self, owner: Item, shape: Shape, center: np.ndarray, contact: np.ndarray) -> bool:
        """Check that the joint center of mass lies well inside every contact from here down."""
        reach = 0.3 * np.sqrt(plane.area(contact)) / 2
        if plane.depth_inside(center[None, :2], contact) < reach:
            return False
        mass, moment = shape.volume, shape.volume * center
        for below in (owner, *owner.ancestors()):
            if below.level == 0:
                break
            mass, moment = mass + below.mass[0], moment + below.mass[0] * below.mass[1]
            reach = 0.3 * np.sqrt(plane.area(below.contact)) / 2
            if plane.depth_inside((moment / mass)[None, :2], below.contact) < reach:
                return False
        return True

    def _is_free(self, outline: np.ndarray, bottom: float, top: float, owner: Item, gap: float) -> bool:
        below = [owner, *owner.ancestors()]
        for other in self.items:
            if any(other is b for b in below) or bottom > other.top_m or top + _ABOVE_M < other.bottom_m:
                continue
            if _far(outline, other.silhouette, gap) or plane.distance(outline, other.silhouette) >= gap:
                continue
            for theirs, low, high in other.solids():
                if bottom > high or top + _ABOVE_M < low or _far(outline, theirs, gap):
                    continue
                if plane.distance(outline, theirs) < gap:
                    return False
        return True

    def open_places(self) -> list[tuple[Item, Place, float]]:
        """Return where things may stand on furniture; the middle and large free areas come first."""
        out = []
        for item in self.items:
            if item.level > 0 or item.key == "crate":
                continue
            for place in item.model.places:
                used = sum(1.6 * plane.area(c.silhouette) for c, p in item.children if p is place)
                left = max(plane.area(place.area) - used, 0.02)
                near = self.near_weight if item.near or item.key in CENTER_KINDS else 1.0
                out.append((item, place, near * left * _LIKED.get(place.name, 1.0)))
        return out

    def stack_places(self) -> list[tuple[Item, Place, float]]:
        """Return the free tops of things; started stacks are rather made higher than new ones begun."""
        out = []
        for item in self.items:
            if not 0 < item.level < self.max_stack or item.children or np.isfinite(item.ceiling_m):
                continue
            if item.parent is not None and any(p.inside for c, p in item.parent.children if c is item):
                continue  # what lies in a container stays as it is
            out += [(item, p, 4.0 ** (item.level - 1)) for p in item.model.places if p.stack]
        return out

    def container_places(self) -> list[tuple[Item, Place, float]]:
        """Return the insides of open containers, empty ones first."""
        out = []
        for item in self.items:
            if item.level < self.max_stack or item.level == 0:
                out += [(item, p, 0.2 ** len(item.children)) for p in item.model.places if p.inside]
        return out


def _lowest(place: Place) -> float:
    """Return how far an uneven support goes down."""
    if place.sag is None:
        return 0.0
    x, y = _samples(place.area)
    return float(np.min(place.sag(x, y)))


def _rest_height(place: Place, foot: np.ndarray, thing: Thing) -> float:
    """Return where a foot rests on an uneven support: soft things give, so it sinks into the highest folds.

    Folds must not come up through the floor of what is hollow.
    """
    x, y = _samples(foot)
    assert place.sag is not None
    heights = place.sag(x, y)
    floors = [p.height_m for p in thing.places if p.inside or p.rim_m > 0]
    through = float(np.max(heights)) - 0.7 * min(floors) if floors else -np.inf
    return max(float(np.percentile(heights, 60)), through)


def _samples(polygon: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return points (x, y) spread over a convex polygon: its corners and rings towards its middle."""
    middle = polygon.mean(0)
    edge = np.concatenate([polygon, 0.5 * (polygon + np.roll(polygon, -1, axis=0))])
    points = np.concatenate([middle + share * (edge - middle) for share in (0.0, 0.35, 0.7, 1.0)])
    return points[:, 0], points[:, 1]


def _upright(yaw: float, x: float, y: float, z: float) -> np.ndarray:
    c, s = np.cos(yaw), np.sin(yaw)
    return rigid(np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]]), np.array([x, y, z], float))
