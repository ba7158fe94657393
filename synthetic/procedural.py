"""Procedural rooms for benchmarks: any number of things, stacks, containers, things on walls, plain surfaces.

`build_procedural_room(RoomSpec(...))` returns the same `Room` as `room.build_room`, so that the film crew, the
ground truth and the tests treat both alike.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np

from registry.errors import UsageError
from synthetic import textures
from synthetic.arrangements import LAYOUTS, arrange
from synthetic.containers import CONTAINER_KINDS, VESSEL_KINDS
from synthetic.furnishing import SIDE_KINDS, WALL_KINDS
from synthetic.furniture import Workshop
from synthetic.furniture_families import FURNITURE_FAMILIES, role_of, shape_families, shape_keys
from synthetic.layout import KINDS, Item, Layout, RoomIsFull, RoomShape, kind_of
from synthetic.model_library import PREFIX as MODELS
from synthetic.model_library import library
from synthetic.room import Entity, Room
from synthetic.shapes import COARSE, Patch, Solid, box, moved, shifted
from synthetic.textures import Texture
from synthetic.things import SMALL_KINDS

_WALL_THICKNESS_M = 0.1
_ATTEMPTS = 20  # five sufficed for every preset, size and seed that was tried
_SUPPORTS = ("book", "box", "package", "plate", "tin", "carton")
_STACKED = (
    "book", "package", "tin", "block", "can", "jar", "mug", "cup", "candle", "box", "bottle", "wedge", "calendar",
)  # fmt: skip
_CONTENTS = ("package", "tin", "block", "can", "jar", "mug", "cup", "candle", "wedge", "ball", "lemon")
_MORE = ("nightstand", "dresser", "trolley", "sideboard")
_FREE = tuple(key for key in (*SMALL_KINDS, *VESSEL_KINDS) if not KINDS[key].rolls)


@dataclass(frozen=True)
class RoomSpec:
    """What a procedural room is made of; the same spec gives the same room."""

    seed: int = 0
    """Varies kinds, sizes, places, colors and prints."""
    objects: int = 12
    """Number of things, furniture and what hangs on walls included; 5 to 40 are tried."""
    max_stack: int = 3
    """How high things may be stacked on furniture; 1: nothing stands on another thing."""
    stacks: float = 0.25
    """Share of the small things that stand on other small things."""
    containers: float = 0.08
    """Share of all things that are open containers; each holds one to three others."""
    side_furniture: float = 0.16
    """Share of all things that is furniture along the walls; one table stands in the middle, two beyond 16 things."""
    wall_things: float = 0.12
    """Share of all things that hang on walls."""
    textureless_share: float = 0.0
    """Share of the things that have one plain color per part."""
    blank_walls: bool = False
    """Walls and floor without any texture."""
    clutter_gap_m: float = 0.05
    """Smallest distance between neighbors on the same support; inside containers at most 12 mm."""
    crowding: float = 0.0
    """Share of the things that are put right beside another one, where there is room."""
    walls: int = 3
    """3: the side that the camera comes from is open; 4: a closed room."""
    step_m: float = 0.03
    """Fineness of the drawn surface, which carries the light."""
    density: float = 1.0
    """Factor on the resolution of all textures; 1 suits 640x480."""
    families: tuple[str, ...] = ()
    """Families of small things (`shape_families`) that are mixed in."""
    furniture: tuple[str, ...] = ()
    """Families of furniture (`furniture_families`) that are mixed in."""
    household: bool = True
    """Use the household's own kinds, too, where a family offers kinds."""
    layout: str = "walk_around"
    """How the furniture stands: one of `arrangements.LAYOUTS`."""
    uneven: float = 0.0
    """Share of the supports that get a cloth in folds."""

    def __post_init__(self) -> None:
        """Refuse what cannot be built."""
        for name in ("families", "furniture"):  # JSON knows lists only
            object.__setattr__(self, name, tuple(getattr(self, name)))
        models = (MODELS,) if library().records else ()
        for name, known in (
            ("layout", LAYOUTS),
            ("furniture", {*FURNITURE_FAMILIES, *models}),
            ("families", {*shape_families(), *models} if self.families else ()),
        ):
            value = getattr(self, name)
            unknown = sorted({value} - set(known) if name == "layout" else set(value) - set(known))
            if unknown:
                raise UsageError(f"RoomSpec: {name}={', '.join(unknown)}, there are {', '.join(known)}")
        if self.layout == "bedroom" and "beds" not in self.furniture:
            raise UsageError("RoomSpec: layout=bedroom needs furniture with 'beds'")
        if self.objects < 3 or self.max_stack < 1 or self.walls not in (3, 4):
            raise UsageError(
                f"RoomSpec: objects={self.objects} (3 or more), max_stack={self.max_stack} (1 or more), "
                f"walls={self.walls} (3 or 4)"
            )
        for name in (
            "stacks",
            "containers",
            "wall_things",
            "side_furniture",
            "textureless_share",
            "crowding",
            "uneven",
        ):
            if not 0 <= getattr(self, name) <= 1:
                raise UsageError(f"RoomSpec: {name}={getattr(self, name)}, expected a share between 0 and 1")

    @property
    def classic(self) -> bool:
        """Return whether the room is furnished from the household alone, around tables in the middle."""
        return (
            self.layout == "walk_around" and not self.families and not self.furniture and self.uneven == 0
        )  # fmt: skip


@dataclass(frozen=True)
class RoomPlan:
    """A laid-out room before it is painted."""

    spec: RoomSpec
    shape: RoomShape
    items: tuple[Item, ...]
    seed: tuple[int, ...]


def plan_room(spec: RoomSpec) -> RoomPlan:
    """Lay a room out; a crowded attempt is given up and the next one is drawn."""
    stuck = ""
    for attempt in range(_ATTEMPTS):
        seed = (spec.seed, spec.objects, attempt)
        try:
            filled = _fill(spec, Layout(seed, spec.max_stack, spec.clutter_gap_m, spec.crowding))
        except RoomIsFull as full:
            stuck = str(full)
            continue
        assert filled.shape is not None
        return RoomPlan(spec, filled.shape, tuple(filled.items), seed)
    raise UsageError(
        f"a room of {spec.objects} objects (seed {spec.seed}) found no place for {stuck} in {_ATTEMPTS} attempts: "
        f"lower objects, clutter_gap_m ({spec.clutter_gap_m}), containers or stacks"
    )


def _fill(spec: RoomSpec, room: Layout) -> Layout:
    """Furnish, hang, then place things from the large to what lies on and in others."""
    if not spec.classic:
        return _fill_from_families(spec, room)
    count = spec.objects
    middle = 1 if count <= 16 else 2
    hanging = min(round(spec.wall_things * count), count - middle - 1)
    side = min(max(round(spec.side_furniture * count - 0.3), 0), count - middle - hanging - 1)
    walls = ("wall_north", "wall_west", "wall_east", "wall_south")[: spec.walls]
    room.furnish_middle(middle, walls)
    for number in range(side):
        keys = [*SIDE_KINDS, "crate"] if spec.containers > 0 else list(SIDE_KINDS)
        room.furnish_side(keys if number else ["bookshelf", "cabinet", "bench"])
    for _ in range(hanging):
        room.hang(WALL_KINDS)
    small = count - middle - side - hanging
    containers = min(round(spec.containers * count), small // 2)
    holders = containers + sum(item.key == "crate" for item in room.items)
    available = max(small - containers - holders, 0)  # every holder gets something
    stacked = min(round(spec.stacks * small), available * (spec.max_stack - 1) // spec.max_stack)
    supports = -(-stacked // (spec.max_stack - 1)) if stacked else 0
    left = small - containers - stacked - supports
    inside = min(int(sum(room.rng.integers(1, 4) for _ in range(holders))), left)
    free = left - inside
    for _ in range(containers):
        room.put(CONTAINER_KINDS, room.open_places)
    for _ in range(supports):
        room.put(_SUPPORTS, room.open_places)
    for number in range(stacked):
        # Every other one has a flat top, so that stacks can grow.
        keys = _SUPPORTS if number % 2 == 0 and number + 1 < stacked else _STACKED
        room.put(keys, lambda: room.stack_places() or room.open_places(), 20)
    for _ in range(inside):
        room.put(_CONTENTS, room.container_places, 20)
    for _ in range(free):
        room.put(_FREE, room.open_places)
    return room


@dataclass(frozen=True)
class _Stock:
    """Which small things a room may hold, by what they are used for."""

    containers: tuple[str, ...]
    supports: tuple[str, ...]
    stacked: tuple[str, ...]
    contents: tuple[str, ...]
    free: tuple[str, ...]
    more: tuple[str, ...]  # furniture for what finds no place


@cache
def _stock(keys: tuple[str, ...], furniture: tuple[str, ...], household: bool) -> _Stock:
    by_role = {key: role_of(key) for key in keys}

    def mix(roles: tuple[str, ...], own: tuple[str, ...]) -> tuple[str, ...]:
        offered = tuple(key for key in keys if by_role[key] in roles)
        return (*offered, *(own if household or not offered else ()))

    return _Stock(
        mix(("container",), tuple(CONTAINER_KINDS)),
        mix(("support",), _SUPPORTS),
        mix(("support", "content", "free"), _STACKED),
        mix(("content", "rolls"), _CONTENTS),
        mix(("support", "content", "free"), _FREE),
        tuple(f"storage_{kind}" for kind in _MORE)
        if "storage" in furniture
        else ("cabinet", "bench", "stool"),
    )


def _fill_from_families(spec: RoomSpec, room: Layout) -> Layout:
    """Furnish as the layout says, then place things; what finds no place where it was meant for goes elsewhere."""
    arrange(spec, room)
    stock = _stock(tuple(shape_keys(spec.families)), spec.furniture, spec.household)
    small = spec.objects - len(room.items)
    containers = min(round(spec.containers * spec.objects), small // 2)
    available = small - 2 * containers
    stacked = min(round(spec.stacks * small), available * (spec.max_stack - 1) // spec.max_stack)
    supports = -(-stacked // (spec.max_stack - 1)) if stacked else 0
    holders = containers + sum(item.key == "crate" for item in room.items)
    left = small - containers - stacked - supports
    inside = min(int(sum(room.rng.integers(1, 4) for _ in range(holders))), left)
    for _ in range(containers):
        _put(room, stock, stock.containers, room.open_places)
    for _ in range(supports):
        _put(room, stock, stock.supports, room.open_places)
    for _ in range(stacked):
        _put(room, stock, stock.stacked, room.stack_places)
    for _ in range(inside):
        _put(room, stock, stock.contents, room.container_places)
    for _ in range(left - inside):
        _put(room, stock, stock.free, room.open_places)
    return room


def _put(room: Layout, stock: _Stock, keys: tuple[str, ...], places: Callable[[], list]) -> None:
    """Put a thing where it is meant to be, else anywhere; a room that is full gets one more piece of furniture."""
    ways: tuple[Callable[[], object], ...] = (
        lambda: room.put(keys, places, 3),
        lambda: room.put(stock.free, room.open_places, 3),
        lambda: room.furnish_side(stock.more),
        lambda: room.put(stock.contents, room.container_places, 2),
        lambda: room.put(stock.free, room.stack_places if room.max_stack > 1 else room.open_places, 4),
    )
    for way in ways:
        try:
            way()
            return
        except RoomIsFull:
            continue
    raise RoomIsFull("small things")


def build_procedural_room(spec: RoomSpec) -> Room:
    """Return a furnished room with true geometry and relations."""
    return furnish(plan_room(spec))


def furnish(plan: RoomPlan) -> Room:
    """Paint a plan: fine surfaces for drawing, coarse closed solids as the truth."""
    spec = plan.spec
    rng = np.random.default_rng((*plan.seed, 0))
    looks, entities = _base(plan, rng)
    ids = {e.name: e.id for e in entities}
    chosen = rng.permutation(len(plan.items))[: round(spec.textureless_share * len(plan.items))]
    for number, item in enumerate(plan.items):
        kind = kind_of(item.key)
        shop = Workshop(np.random.default_rng(item.stream), 0.7 * spec.step_m, spec.density)
        fine = kind.make(shop, f"{item.name}/")
        painted = (
            {name: _flattened(look) for name, look in fine.textures.items()}
            if number in chosen
            else fine.textures
        )
        looks |= painted
        patches = tuple(patch for part in fine.parts for patch in moved(part, item.pose))
        entity = _entity(item, len(entities) + 1, ids[item.support], patches)
        entities.append(entity)
        ids[item.name] = entity.id
    s = plan.shape
    return Room(tuple(entities), looks, (s.west, s.east, s.south, s.north))


def unpainted(plan: RoomPlan) -> Room:
    """Return the truth of a plan alone, in a fraction of the time: no textures, nothing to film."""
    entities = [
        _base_entity(number, name, label, solid, ())
        for number, (name, label, solid) in enumerate(_base_solids(plan.shape, COARSE), start=1)
    ]
    ids = {e.name: e.id for e in entities}
    for item in plan.items:
        entities.append(_entity(item, len(entities) + 1, ids[item.support], ()))
        ids[item.name] = entities[-1].id
    s = plan.shape
    return Room(tuple(entities), {}, (s.west, s.east, s.south, s.north))


def _entity(item: Item, number: int, parent: int, patches: tuple[Patch, ...]) -> Entity:
    points = np.concatenate([p.vertices for part in item.model.parts for p in part])
    return Entity(
        id=number,
        name=item.name,
        label=kind_of(item.key).label,
        base=False,
        relation="attached_to" if item.hangs else "supported_by",
        parent=parent,
        fixed=kind_of(item.key).fixed,
        size=tuple(np.ptp(points, axis=0).tolist()),
        world_from_object=item.pose,
        solids=tuple(moved(part, item.pose) for part in item.model.parts),
        patches=patches,
        pieces=tuple(p @ item.pose[:3, :3].T + item.pose[:3, 3] for p in item.model.pieces),
    )


def _flattened(look: Texture) -> Texture:
    return textures.plain(tuple(look.pixels.reshape(-1, 3).mean(0).tolist()))


def _base(plan: RoomPlan, rng: np.random.Generator) -> tuple[dict[str, Texture], list[Entity]]:
    """Return the looks and the entities of floor and walls."""
    looks = _base_looks(plan, rng)
    entities = []
    for (name, label, fine), (_, _, coarse) in zip(
        _base_solids(plan.shape, plan.spec.step_m), _base_solids(plan.shape, COARSE)
    ):
        entities.append(_base_entity(len(entities) + 1, name, label, coarse, fine))
    return looks, entities


def _base_entity(number: int, name: str, label: str, coarse: Solid, fine: tuple[Patch, ...]) -> Entity:
    size = tuple(np.ptp(np.concatenate([p.vertices for p in coarse]), axis=0).tolist())
    return Entity(number, name, label, True, None, None, True, size, np.eye(4), (coarse,), fine)


def _base_solids(shape: RoomShape, step_m: float) -> list[tuple[str, str, Solid]]:
    """Return (name, label, solid) of floor and walls: slabs whose inner faces are the planes."""
    wall_step = step_m if step_m >= COARSE else max(step_m, min(3 * step_m, 0.12))  # light on walls is soft
    t, high = _WALL_THICKNESS_M, shape.wall_height_m
    wide, deep = shape.east - shape.west, shape.north - shape.south
    x, y = (shape.west + shape.east) / 2, (shape.south + shape.north) / 2
    floor = box((wide + 2 * t, deep + 2 * t, t), {"+z": "floor", "*": "edge"}, step_m)
    out = [("floor", "floor", shifted(floor, x, y, -t))]
    walls = {
        "wall_north": ((wide + 2 * t, t, high), "-y", (x, shape.north + t / 2)),
        "wall_west": ((t, deep, high), "+x", (shape.west - t / 2, y)),
        "wall_east": ((t, deep, high), "-x", (shape.east + t / 2, y)),
        "wall_south": ((wide + 2 * t, t, high), "+y", (x, shape.south - t / 2)),
    }
    for name in shape.walls:
        size, face, at = walls[name]
        out.append((name, "wall", shifted(box(size, {face: name, "*": "edge"}, wall_step), *at)))
    return out


_WALL_TONES = (
    (214, 198, 178),
    (196, 206, 190),
    (190, 202, 214),
    (222, 206, 170),
    (206, 190, 196),
    (228, 224, 214),
)


_FLOOR_TONES = (
    (150, 132, 112),
    (196, 190, 180),
    (92, 90, 90),
    (172, 136, 96),
    (120, 76, 52),
    (126, 138, 128),
)


def _base_looks(plan: RoomPlan, rng: np.random.Generator) -> dict[str, Texture]:
    shape, density = plan.shape, plan.spec.density
    names = ("floor", *shape.walls)
    if plan.spec.blank_walls:
        looks = {}
        for name in names:
            tones = _FLOOR_TONES[: 1 if plan.spec.classic else None] if name == "floor" else _WALL_TONES
            tone = tones[int(rng.integers(len(tones)))] if len(tones) > 1 else tones[0]
            looks[name] = textures.plain(tone)
        return looks | {"edge": textures.plain((120, 120, 120))}
    wide, deep = shape.east - shape.west + 0.2, shape.north - shape.south + 0.2
    if rng.random() < 0.6:
        tone = ((150, 112, 80), (178, 146, 108), (118, 88, 66))[int(rng.integers(3))]
        floor = textures.wood(rng, wide, deep, 380 * density, tone, boards=float(rng.uniform(0.1, 0.16)))
    else:
        tone = ((176, 168, 156), (150, 150, 146))[int(rng.integers(2))]
        floor = textures.tiles(rng, wide, deep, 380 * density, float(rng.uniform(0.25, 0.4)), tone)
    looks = {"floor": floor, "edge": textures.plain((120, 120, 120))}
    order = rng.permutation(len(_WALL_TONES))
    for number, name in enumerate(shape.walls):
        long = wide if name in ("wall_north", "wall_south") else deep
        tone = _WALL_TONES[int(order[number])]
        paper = number == int(order[-1]) % len(shape.walls)
        maker = textures.wallpaper if paper else textures.plaster
        looks[name] = maker(rng, long, shape.wall_height_m, 340 * density, tone)
    return looks
