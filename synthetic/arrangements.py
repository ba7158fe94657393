"""How procedural rooms are furnished: around a table, against a wall, in a corner, to live, sleep, eat or work in.

Every arrangement draws the main furniture, decides the size of the room and the camera's way (`RoomShape`), and
stands the other furniture off that way. `draw_room` draws a whole room at random.
"""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from synthetic.furnishing import CENTER_KINDS, SIDE_KINDS, WALL_KINDS
from synthetic.furniture_families import FURNITURE_FAMILIES, furniture_keys
from synthetic.layout import Item, Layout, RoomIsFull, RoomShape, Shape
from synthetic.model_library import PREFIX as MODELS
from synthetic.model_library import library

if TYPE_CHECKING:
    from synthetic.procedural import RoomSpec

Drawn = tuple[str, tuple[int, ...], Shape]
_ARC_DEG = (-172.0, -8.0)  # where the camera goes in rooms that are furnished on one side
_AISLE_M = 0.78  # of the camera from what it walks around
_BACK_M = 0.025  # between furniture and the wall behind it
_LOW_TABLES = ("coffee", "pedestal", "oval", "nested")
_HIGH_TABLES = ("dining", "trestle", "cloth", "oval", "pedestal")
_DESKS = ("drawer_desk", "panel_desk", "trestle", "dining")


class Choice:
    """Which kinds a room may be furnished with, by what they are for."""

    def __init__(self, spec: "RoomSpec") -> None:
        """Read the families of a room; household kinds stand in where no family offers any."""
        self.spec = spec
        self.household = spec.household

    def _of(self, family: str, kinds: Sequence[str] = ()) -> list[str]:
        if family not in self.spec.furniture:
            return []
        return [f"{family}_{kind}" for kind in (kinds or FURNITURE_FAMILIES[family])]

    def _models(self, *uses: str) -> list[str]:
        return library().keys(*uses) if MODELS in self.spec.furniture else []

    def _or(self, offered: list[str], household: Sequence[str]) -> list[str]:
        return [*offered, *(household if self.household or not offered else ())]

    def middle(self) -> list[str]:
        """Tables to walk around."""
        return self._or([*self._of("tables"), *self._models("table", "low_table")], tuple(CENTER_KINDS))

    def low_tables(self) -> list[str]:
        """Tables before a sofa."""
        return self._or([*self._of("tables", _LOW_TABLES), *self._models("low_table")], tuple(CENTER_KINDS))

    def high_tables(self) -> list[str]:
        """Tables to eat at."""
        return [*self._of("tables", _HIGH_TABLES), *self._models("table")] or list(CENTER_KINDS)

    def wall_mains(self) -> list[str]:
        """What one may work at with a wall behind it."""
        mains = self._of("tables", _DESKS) + self._of("storage", ("sideboard", "dresser", "counter"))
        mains += self._of("seating", ("sofa",)) + self._models("table", "couch")
        return self._or(mains, ("table", "bench", "cabinet"))

    def couches(self) -> list[str]:
        """Sofas."""
        return (
            self._of("seating", ("sofa",)) + self._models("couch")
            or self._of("beds", ("daybed",))
            or ["bench"]
        )

    def chairs(self) -> list[str]:
        """Chairs to sit at a table."""
        seats = self._of("seating", ("chair", "chair", "stool", "office_chair")) + self._models("seat")
        return self._or(seats, ("chair", "stool"))

    def soft_seats(self) -> list[str]:
        """What stands around a low table."""
        return self._or(self._of("seating", ("armchair", "pouf", "stool")), ("stool",))

    def side(self) -> list[str]:
        """What stands along walls."""
        stored = self._of("storage", ("open_shelf", "wardrobe", "dresser", "trolley", "sideboard", "fridge"))
        seats = self._of("seating", ("bench", "pouf", "stool", "chair", "armchair"))
        keys = self._or(stored + seats + self._models("side", "seat"), tuple(SIDE_KINDS))
        return [*keys, "crate"] if self.spec.containers > 0 and self.household else keys

    def walls(self) -> list[str]:
        """What hangs on walls."""
        return self._or(self._of("wall") + self._models("wall"), tuple(WALL_KINDS))


def _size(shape: Shape) -> np.ndarray:
    return shape.high[:2] - shape.low[:2]


def _reach(items: Sequence[Item]) -> np.ndarray:
    return np.abs(np.concatenate([i.silhouette for i in items])).max(0)


def _top(items: Sequence[Item]) -> float:
    """Return the height of the lowest support among the main furniture's highest."""
    tops = [max((p.height_m for p in i.model.places), default=0.5) for i in items]
    return float(min(tops, default=0.5))


def _close(
    room: Layout, spec: "RoomSpec", half: tuple[float, float], mains: Sequence[Item], *, north: float,
    west: float | None = None, east: float | None = None, facing: float = 0.0, around: bool = False,
) -> None:  # fmt: skip
    """Decide the walls: given, or as far as the camera and a little furniture need."""
    walls = ("wall_north", "wall_west", "wall_east", "wall_south")[: spec.walls]
    aside = 0.36 + 0.52
    more = room.rng.uniform((0.0, 0.0, 0.0), (0.7, 0.7, 0.5))
    west = -(half[0] + aside + more[0]) if west is None else west
    east = half[0] + aside + more[1] if east is None else east
    south = -(half[1] + (aside + more[2] if "wall_south" in walls else 0.7))
    high = float(room.rng.uniform(2.25, 2.5))
    free = (-180.0, 180.0) if around else _ARC_DEG
    room.shape = RoomShape(
        west, east, south, north, walls, half, facing, free, high, _top(mains), spec.layout
    )  # fmt: skip


def _walk_around(spec: "RoomSpec", room: Layout, choice: Choice, away_m: float = _AISLE_M) -> None:
    """One or two tables in the middle."""
    keys = choice.middle()
    if spec.layout == "tabletop":
        keys = [k for k in keys if k.split("_", 1)[-1] not in ("bar", "nested")]
    first = room.draw(keys)
    drawn = [first] if spec.objects <= 16 or spec.layout == "tabletop" else [first, room.draw(keys)]
    widths = [float(_size(shape)[0]) for *_, shape in drawn]
    x, mains = -(sum(widths) + 0.1 * (len(drawn) - 1)) / 2, []
    for (key, stream, shape), width in zip(drawn, widths):
        yaw = np.radians(room.rng.uniform(-6, 6)) if len(drawn) == 1 else 0.0
        at = x - float(shape.low[0]), -float(shape.low[1] + shape.high[1]) / 2
        mains.append(room.stand((key, stream, shape), yaw, *at, near=True))
        x += width + 0.1
    half = tuple(float(v) + away_m for v in _reach(mains))
    north = half[1] + 0.36 + 0.52 + float(room.rng.uniform(0, 0.6))
    _close(room, spec, half, mains, north=north, around=True)


def _tabletop(spec: "RoomSpec", room: Layout, choice: Choice) -> None:
    """One table that the camera comes close to, and where nearly everything stands."""
    room.near_weight = 8.0
    _walk_around(spec, room, choice, float(room.rng.uniform(0.42, 0.55)))


def _against_wall(spec: "RoomSpec", room: Layout, choice: Choice) -> None:
    """A desk, a counter or a sofa at the north wall, at times a row of it, and something beside it."""
    first = room.draw(choice.wall_mains())
    kind = first[0].split("_", 1)[-1]
    number = int(room.rng.integers(2, 4)) if kind == "counter" else 1
    width, depth = _size(first[2])
    x, mains = -number * width / 2, []
    for _ in range(number):
        mains.append(
            room.stand(first, 0.0, x - float(first[2].low[0]), -float(first[2].low[1] + depth / 2), near=True)
        )
        x += width + 0.004
    reach = _reach(mains)
    chair = spec.objects >= 7 and kind in (*_DESKS, "table") and room.rng.random() < 0.6
    away = _AISLE_M + (0.3 if chair else 0.0)
    half = (float(reach[0]) + _AISLE_M, float(reach[1]) + away)
    _close(room, spec, half, mains, north=float(reach[1]) + _BACK_M)
    if chair:
        drawn = room.draw(choice.chairs())
        _push_in(room, drawn, (float(room.rng.uniform(-0.25, 0.25)) * width, -float(reach[1])), np.pi)
    if spec.objects >= 8:
        _beside(room, room.draw(choice.side()), mains)


def _beside(room: Layout, drawn: Drawn, mains: Sequence[Item]) -> bool:
    """Stand a piece beside the main furniture at the north wall, if there is room off the way."""
    shape = drawn[2]
    size, north = _size(shape), room.shape.north if room.shape else 0.0
    y = north - _BACK_M - float(shape.high[1])
    edge = float(_reach(mains)[0])
    for gap in (0.02, 0.08, 0.2, 0.35):
        for sign in room.rng.permutation([-1.0, 1.0]):
            x = float(sign * (edge + gap + size[0] / 2))
            if room.may_stand(shape, 0.0, x, y, 0.01):
                room.stand(drawn, 0.0, x, y)
                return True
    return False


def _push_in(room: Layout, drawn: Drawn, edge: tuple[float, float], yaw: float) -> bool:
    """Push a chair below a table's edge as far as it goes, or less; it faces the table with a little turn.

    `edge` is the point of the edge, `yaw` turns the chair (which faces -y) towards the table.
    """
    shape = drawn[2]
    inwards = np.array([np.sin(yaw), -np.cos(yaw)])
    deep = float(_size(shape)[1])
    turn = yaw + np.radians(room.rng.uniform(-12, 12))
    pushed = float(room.rng.uniform(-0.2, 0.75)) * deep
    for less in np.linspace(0.0, pushed + 0.16, 6):
        at = np.array(edge) + inwards * (pushed - less - deep / 2 + float(shape.high[1] + shape.low[1]) / 2)
        if room.may_stand(shape, turn, *at, gap_m=0.012):
            room.stand(drawn, turn, float(at[0]), float(at[1]))
            return True
    return False


def _corner(spec: "RoomSpec", room: Layout, choice: Choice) -> None:
    """Counters or other storage in an L along two walls, wall cabinets above, at times a table in the middle."""
    rng = room.rng
    side = "wall_west" if rng.random() < 0.5 else "wall_east"
    sign = -1.0 if side == "wall_west" else 1.0
    kitchen = "storage" in spec.furniture
    mains: list[Item] = []
    if spec.objects >= 9 and rng.random() < 0.35:
        mains.append(room.stand(room.draw(choice.middle()), 0.0, 0.0, 0.0, near=True))
    reach = _reach(mains) if mains else np.array([0.1, 0.1])
    half = tuple(float(v) for v in (reach + 0.7 if mains else rng.uniform(1.25, 1.65, 2)))
    keys = ["storage_counter"] if kitchen else ["cabinet", "bench"]
    first = room.draw(keys)
    width, depth = _size(first[2])
    budget = max(3, min(6, spec.objects // 3))
    on_north = max(2, -(-budget // 2))
    inner_x, inner_y = float(rng.uniform(0.15, 0.45)), float(rng.uniform(0.15, 0.45))
    if mains:  # an aisle between the table and the rows
        inner_x = max(float(reach[0]) + 0.65, 0.5 * half[0] + 0.41)
        inner_y = max(float(reach[1]) + 0.65, 0.5 * half[1] + 0.41)
    wall_x, north = inner_x + depth + _BACK_M, inner_y + depth + _BACK_M
    facing = -sign * np.pi / 4
    given = {"west" if sign < 0 else "east": sign * wall_x}
    _close(room, spec, half, mains, north=north, facing=facing, **given)
    shape = room.shape
    assert shape is not None
    # Along the north wall from the corner, then along the side wall from below that row.
    y = north - _BACK_M - float(first[2].high[1])
    for number in range(on_north):
        x = sign * (wall_x - _BACK_M - (number + 0.5) * (width + 0.004))
        if room.may_stand(first[2], 0.0, x, y, 0.001):
            mains.append(room.stand(first, 0.0, x, y, near=True))
    yaw = np.pi / 2 if sign < 0 else -np.pi / 2
    x = sign * (wall_x - _BACK_M - float(first[2].high[1]))
    drawn, low = first, north - _BACK_M - depth - 0.02
    for number in range(budget - on_north):
        if number == budget - on_north - 1 and kitchen and rng.random() < 0.5:
            drawn = room.draw(["storage_fridge", "storage_dresser", "storage_open_shelf"])
            x = sign * (wall_x - _BACK_M - float(drawn[2].high[1]))
        y = low - float(_size(drawn[2])[0]) / 2
        if room.may_stand(drawn[2], yaw, x, y, 0.001):
            mains.append(room.stand(drawn, yaw, x, y, near=True))
            low -= float(_size(drawn[2])[0]) + 0.006
    if kitchen and spec.objects >= 8:
        _cabinets_above(room, mains, first, int(rng.integers(1, 4)))


def _cabinets_above(room: Layout, mains: Sequence[Item], counter: Drawn, count: int) -> None:
    """Hang cupboards of one build in a row over the counters at the north wall."""
    drawn = room.draw(["storage_wall_cabinet"])
    shape = room.shape
    assert shape is not None
    under = [i for i in mains if i.key == counter[0] and abs(i.pose[1, 0]) < 1e-6]
    if not under:
        return
    ends = np.concatenate([i.silhouette[:, 0] for i in under])
    width = float(_size(drawn[2])[0]) + 0.004
    z = min(
        _top(under) + float(room.rng.uniform(0.45, 0.58)),
        shape.wall_height_m - float(drawn[2].high[2]) - 0.02,
    )
    fits = min(count, int(np.ptp(ends) / width))
    from_east = abs(ends.max() - shape.east) < abs(ends.min() - shape.west)
    for number in range(fits):
        x = (number + 0.5) * width
        room.hang_at(
            drawn, "wall_north", float(ends.max() - x if from_east else ends.min() + x), shape.north, z
        )


def _living(spec: "RoomSpec", room: Layout, choice: Choice) -> None:
    """A low table before a sofa at the wall, armchairs or poufs at its sides, a shelf."""
    rng = room.rng
    table = room.stand(room.draw(choice.low_tables()), np.radians(rng.uniform(-5, 5)), 0.0, 0.0, near=True)
    reach = _reach([table])
    sofa = room.draw(choice.couches())
    _, deep = _size(sofa[2])
    gap = float(rng.uniform(0.26, 0.42))
    y = float(table.silhouette[:, 1].max()) + gap - float(sofa[2].low[1])
    half = (float(max(reach[0], 0.42 * _size(sofa[2])[0])) + _AISLE_M, float(reach[1]) + _AISLE_M)
    north = y + float(sofa[2].high[1]) + _BACK_M
    _close(room, spec, half, [table], north=north)
    room.stand(sofa, 0.0, float(rng.uniform(-0.15, 0.15)), y, near=True)
    for sign in rng.permutation([-1.0, 1.0])[: 1 + (spec.objects >= 12)]:
        if spec.objects < 8:
            break
        seat = room.draw(choice.soft_seats())
        for _ in range(8):
            x = sign * (float(reach[0]) + float(rng.uniform(0.2, 0.5)) + deep / 2)
            side = float(rng.uniform(0.0, 0.7))
            yaw = (np.pi / 2 if sign < 0 else -np.pi / 2) + np.radians(rng.uniform(-25, 25))
            if room.may_stand(seat[2], yaw, x, side, 0.06):
                room.stand(seat, yaw, x, side)
                break
    if spec.objects >= 7:
        room.furnish_side(choice.side(), ("wall_north", "wall_west", "wall_east"))


def _bedroom(spec: "RoomSpec", room: Layout, choice: Choice) -> None:
    """A bed with its head at the wall, nightstands beside it, a wardrobe."""
    rng = room.rng
    keys = ["beds_single", "beds_double", "beds_daybed"]
    bed = room.draw(keys)
    reach = _size(bed[2]) / 2
    main = room.stand(bed, 0.0, 0.0, -float(bed[2].low[1] + bed[2].high[1]) / 2, near=True)
    half = (float(reach[0]) + 0.66, float(reach[1]) + 0.55)
    _close(room, spec, half, [main], north=float(reach[1]) + _BACK_M)
    kinds = (
        [f"storage_{k}" for k in ("nightstand", "trolley", "dresser")] if "storage" in spec.furniture else []
    )
    stands = kinds or ["stool", "cabinet"]
    for sign in rng.permutation([-1.0, 1.0])[: 1 + (spec.objects >= 9)]:
        drawn = room.draw(stands)
        x = float(sign * (reach[0] + 0.06 + _size(drawn[2])[0] / 2))
        y = float(reach[1]) - float(drawn[2].high[1])
        if room.may_stand(drawn[2], 0.0, x, y, 0.02):
            room.stand(drawn, 0.0, x, y, near=True)
    if spec.objects >= 8:
        tall = (
            ["storage_wardrobe", "storage_dresser", "storage_open_shelf"]
            if kinds
            else ["bookshelf", "cabinet"]
        )
        room.furnish_side(tall, ("wall_west", "wall_east"))


def _dining(spec: "RoomSpec", room: Layout, choice: Choice) -> None:
    """A table with two to six chairs, pushed below it or drawn out."""
    rng = room.rng
    table = room.draw(choice.high_tables())
    main = room.stand(table, 0.0, 0.0, -float(table[2].low[1] + table[2].high[1]) / 2, near=True)
    reach = _reach([main])
    half = (float(reach[0]) + 0.98, float(reach[1]) + 0.98)
    north = half[1] + 0.36 + float(rng.uniform(0.1, 0.8))
    _close(room, spec, half, [main], north=north, around=True)
    chairs = int(min(rng.integers(2, 7), max(2, spec.objects // 3)))
    chair = room.draw(choice.chairs())
    long = float(reach[0])
    spots = [(-0.5 * long, -1), (0.5 * long, 1), (0.5 * long, -1), (-0.5 * long, 1), (0.0, 2), (0.0, -2)]
    if long < 0.45:
        spots = [(0.0, -1), (0.0, 1), (0.0, 2), (0.0, -2)]
    for x, side in [spots[int(k)] for k in rng.permutation(len(spots))][:chairs]:
        if abs(side) == 1:
            edge = (x + float(rng.uniform(-0.06, 0.06)), side * float(reach[1]))
            yaw = np.pi if side < 0 else 0.0
        else:
            edge = (np.sign(side) * long, float(rng.uniform(-0.05, 0.05)))
            yaw = np.pi / 2 if side < 0 else -np.pi / 2
        _push_in(room, chair if rng.random() < 0.85 else room.draw(choice.chairs()), edge, yaw)


ARRANGEMENTS: dict[str, Callable[["RoomSpec", Layout, Choice], None]] = {
    "walk_around": _walk_around,
    "against_wall": _against_wall,
    "corner": _corner,
    "living": _living,
    "bedroom": _bedroom,
    "dining": _dining,
    "tabletop": _tabletop,
}
"""Layouts by name."""
LAYOUTS: tuple[str, ...] = tuple(ARRANGEMENTS)
NEEDED_FAMILY = {"bedroom": "beds", "living": "seating", "corner": "storage", "dining": "tables"}


def arrange(spec: "RoomSpec", room: Layout) -> None:
    """Furnish a room: its main furniture, more along the walls, what hangs."""
    choice = Choice(spec)
    ARRANGEMENTS[spec.layout](spec, room, choice)
    most = max(1, round((0.3 if spec.layout == "tabletop" else 0.5) * spec.objects))  # the rest is small
    if len(room.items) > max(most, 2):
        raise RoomIsFull("furniture")
    wanted = min(round(spec.side_furniture * spec.objects - 0.3), most - len(room.items))
    standing = sum(1 for i in room.items if not i.near)
    for _ in range(max(wanted - standing, 0)):
        _if_room(lambda: room.furnish_side(choice.side()))
    hanging = round(spec.wall_things * spec.objects) - sum(i.hangs for i in room.items)
    for _ in range(max(min(hanging, most - len(room.items)), 0)):
        _if_room(lambda: room.hang(choice.walls()))
    supports = sum(1 for i in room.items if i.model.places)
    for _ in range(min(round(spec.uneven * supports), max(spec.objects - len(room.items) - 1, 0))):
        room.lay_cloth()


def _if_room(place: Callable[[], object]) -> bool:
    """Try to place something that the room may also do without."""
    try:
        place()
    except RoomIsFull:
        return False
    return True


__all__ = ["ARRANGEMENTS", "LAYOUTS", "Choice", "arrange", "furniture_keys"]
