"""Procedural rooms for benchmarks: any number of things, stacks, containers, things on walls, plain surfaces.

`build_procedural_room(RoomSpec(...))` returns the same `Room` as `room.build_room`, so that the film crew, the
ground truth and the tests treat both alike.
"""

from dataclasses import dataclass

import numpy as np

from registry.errors import UsageError
from synthetic import textures
from synthetic.containers import CONTAINER_KINDS, VESSEL_KINDS
from synthetic.furnishing import SIDE_KINDS, WALL_KINDS
from synthetic.furniture import Workshop
from synthetic.layout import KINDS, Item, Layout, RoomIsFull, RoomShape
from synthetic.room import WALL_HEIGHT_M, Entity, Room
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

    def __post_init__(self) -> None:
        """Refuse what cannot be built."""
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
        ):
            if not 0 <= getattr(self, name) <= 1:
                raise UsageError(f"RoomSpec: {name}={getattr(self, name)}, expected a share between 0 and 1")


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
        kind = KINDS[item.key]
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
        label=KINDS[item.key].label,
        base=False,
        relation="attached_to" if item.hangs else "supported_by",
        parent=parent,
        fixed=KINDS[item.key].fixed,
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
    t, high = _WALL_THICKNESS_M, WALL_HEIGHT_M
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


def _base_looks(plan: RoomPlan, rng: np.random.Generator) -> dict[str, Texture]:
    shape, density = plan.shape, plan.spec.density
    names = ("floor", *shape.walls)
    if plan.spec.blank_walls:
        looks = {}
        for name in names:
            tone = (150, 132, 112) if name == "floor" else _WALL_TONES[int(rng.integers(len(_WALL_TONES)))]
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
        looks[name] = maker(rng, long, WALL_HEIGHT_M, 340 * density, tone)
    return looks
