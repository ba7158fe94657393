"""Furnish a room: floor, three walls, things that stand exactly on each other; true entities and relations.

World space: metres, +z up, floor at z = 0. The table stands near the origin, walls are to the north (+y),
west (-x) and east (+x); the south is open, where the camera walks.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from registry.geometry import rigid
from synthetic import textures
from synthetic.furniture import MAKERS, Model, Workshop
from synthetic.shapes import COARSE, Patch, Solid, box, moved, shifted
from synthetic.textures import Texture

WEST_M, EAST_M, NORTH_M, SOUTH_M = -2.0, 2.1, 1.55, -2.6
WALL_HEIGHT_M = 2.5
_WALL_THICKNESS_M = 0.1


@dataclass(frozen=True)
class Entity:
    """One true thing, as in `ground_truth/scene.json`."""

    id: int
    name: str
    label: str
    base: bool
    relation: str | None  # "supported_by" | "attached_to"; None for the base
    parent: int | None
    fixed: bool  # True: does not move (base, furniture, what hangs)
    size: tuple[float, float, float]  # metres, in object space
    world_from_object: np.ndarray  # float64 (4, 4)
    solids: tuple[Solid, ...]  # coarse closed parts in world space
    patches: tuple[Patch, ...]  # fine textured surface in world space, for drawing
    pieces: tuple[np.ndarray, ...] = ()  # convex (v, 3), world space; set where a solid is hollow

    def mesh(self):
        """Return the outer surface in world space as a `trimesh.Trimesh`.

        It is closed, the union of the parts, unless one of them is open, as in meshes of others: then it is all parts.
        """
        import trimesh

        parts = []
        for solid in self.solids:
            offsets = np.cumsum([0] + [len(p.vertices) for p in solid[:-1]])
            vertices = np.concatenate([p.vertices for p in solid])
            faces = np.concatenate([p.faces + o for p, o in zip(solid, offsets)])
            part = trimesh.Trimesh(vertices, faces, process=False)
            part.merge_vertices(merge_tex=True, merge_norm=True, digits_vertex=7)
            part.update_faces(part.nondegenerate_faces())
            parts.append(part)
        if len(parts) > 1 and all(part.is_volume for part in parts):
            return trimesh.boolean.union(parts, engine="manifold")
        return trimesh.util.concatenate(parts)


@dataclass(frozen=True)
class Room:
    """A furnished room."""

    entities: tuple[Entity, ...]
    textures: dict[str, Texture]
    extent: tuple[float, float, float, float] = (WEST_M, EAST_M, SOUTH_M, NORTH_M)

    @property
    def base(self) -> tuple[Entity, ...]:
        """Return floor and walls."""
        return tuple(e for e in self.entities if e.base)

    @property
    def objects(self) -> tuple[Entity, ...]:
        """Return what is not floor or wall."""
        return tuple(e for e in self.entities if not e.base)

    def entity(self, name: str) -> Entity:
        """Return the entity of this name."""
        for entity in self.entities:
            if entity.name == name:
                return entity
        raise KeyError(f"no entity {name!r} in this room; there are {[e.name for e in self.entities]}")


@dataclass(frozen=True)
class Spot:
    """Where a thing goes: on (or on the wall of) its parent, at x, y of the parent's object space."""

    kind: str
    parent: str
    x_m: float
    y_m: float
    yaw_deg: float = 0.0
    surface: str = "top"  # which of the parent's surfaces; "wall" hangs it
    z_m: float = 0.0  # height of its bottom where it hangs


DEFAULT_PLAN: tuple[Spot, ...] = (
    Spot("table", "floor", 0.0, 0.0, 0.0),
    Spot("shelf", "floor", -1.05, NORTH_M - 0.16, 0.0),
    Spot("crate", "floor", 1.12, 0.62, -24.0),
    Spot("box", "shelf", 0.08, -0.01, 8.0),
    Spot("picture", "wall_north", 0.30, 0.0, 0.0, "wall", 0.84),
    Spot("can", "table", -0.34, 0.16, 20.0),
    Spot("carton", "table", -0.30, -0.12, 32.0),
    Spot("mug", "table", -0.04, -0.17, -35.0),
    Spot("bowl", "table", 0.04, 0.15, 0.0),
    Spot("book", "table", 0.34, -0.04, 18.0),
    Spot("tin", "book", -0.03, 0.005, 30.0),
)
"""Ten things and a picture; gaps on the table are 6 to 25 cm; can, carton, mug and tin fit a 8 cm gripper."""

OBJECT_KINDS = tuple(spot.kind for spot in DEFAULT_PLAN)


def _plan_of(objects: Sequence[str] | None) -> tuple[Spot, ...]:
    if objects is None:
        return DEFAULT_PLAN
    unknown = sorted(set(objects) - set(OBJECT_KINDS))
    if unknown:
        raise ValueError(f"unknown objects {unknown}; a room may have {list(OBJECT_KINDS)}")
    wanted = set(objects)
    for spot in reversed(DEFAULT_PLAN):  # what a wanted thing stands on comes with it
        if spot.kind in wanted and spot.parent in OBJECT_KINDS:
            wanted.add(spot.parent)
    return tuple(spot for spot in DEFAULT_PLAN if spot.kind in wanted)


def _base_solids(step_m: float) -> list[tuple[str, str, Solid]]:
    """Return (name, label, solid) of floor and walls: slabs whose inner faces are the planes."""
    wall_step_m = (
        max(step_m, min(3 * step_m, 0.12)) if step_m < COARSE else COARSE
    )  # shadows on walls are broad
    t = _WALL_THICKNESS_M
    mid_x, mid_y = (WEST_M + EAST_M) / 2, (SOUTH_M + NORTH_M) / 2
    wide, deep = EAST_M - WEST_M, NORTH_M - SOUTH_M
    floor = box((wide + 2 * t, deep + t, t), {"+z": "floor", "*": "edge"}, step_m)
    north = box((wide + 2 * t, t, WALL_HEIGHT_M), {"-y": "wall_north", "*": "edge"}, wall_step_m)
    west = box((t, deep, WALL_HEIGHT_M), {"+x": "wall_west", "*": "edge"}, wall_step_m)
    east = box((t, deep, WALL_HEIGHT_M), {"-x": "wall_east", "*": "edge"}, wall_step_m)
    return [
        ("floor", "floor", shifted(floor, mid_x, mid_y + t / 2, -t)),
        ("wall_north", "wall", shifted(north, mid_x, NORTH_M + t / 2)),
        ("wall_west", "wall", shifted(west, WEST_M - t / 2, mid_y)),
        ("wall_east", "wall", shifted(east, EAST_M + t / 2, mid_y)),
    ]


def _base_textures(rng: np.random.Generator, density: float, blank_walls: bool) -> dict[str, Texture]:
    wide, deep = EAST_M - WEST_M + 0.2, NORTH_M - SOUTH_M + 0.1
    look = {
        "floor": textures.wood(rng, wide, deep, 420 * density, (150, 112, 80), boards=0.14),
        "wall_north": textures.wallpaper(rng, wide, WALL_HEIGHT_M, 400 * density, (196, 206, 190)),
        "wall_west": textures.plaster(rng, deep, WALL_HEIGHT_M, 400 * density, (214, 198, 178), 7),
        "wall_east": textures.plain((232, 230, 226)),
        "edge": textures.plain((120, 120, 120)),
    }
    if blank_walls:
        look |= {name: textures.plain((226, 224, 220)) for name in ("floor", "wall_north", "wall_west")}
    return look


def _place(
    spot: Spot,
    rng: np.random.Generator,
    jitter: float,
    models: dict[str, Model],
    poses: dict[str, np.ndarray],
) -> np.ndarray:
    """Return world_from_object; contact is exact: the bottom lies in the plane of the parent's surface."""
    dx, dy, turn = rng.uniform(-1, 1, 3) * (0.012, 0.012, 10.0) * jitter
    if spot.surface == "wall":
        return rigid(translation=np.array([spot.x_m + 8 * dx, NORTH_M, spot.z_m + 8 * dy]))
    yaw = np.radians(spot.yaw_deg + (turn if spot.yaw_deg else 0.0))  # what stands square stays square
    rotation = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1.0]])
    height = models[spot.parent].surfaces[spot.surface] if spot.parent in models else 0.0
    local = rigid(
        rotation, np.array([spot.x_m + dx, spot.y_m + (dy if spot.kind != "shelf" else 0.0), height])
    )
    return poses.get(spot.parent, np.eye(4)) @ local


def build_room(
    seed: int = 0,
    objects: Sequence[str] | None = None,
    *,
    step_m: float = 0.03,
    density: float = 1.0,
    blank_walls: bool = False,
) -> Room:
    """Furnish a room.

    Args:
        seed: Varies colours, prints, grain and, for seeds other than 0, places and turns by a little.
        objects: Kinds to place (see `OBJECT_KINDS`); what they stand on comes with them. None: everything.
        step_m: Fineness of the drawn surface, which carries the light.
        density: Factor on the resolution of all textures.
        blank_walls: Walls and floor without any texture.

    Returns:
        The room, with true geometry and relations.
    """
    rng = np.random.default_rng(seed)
    looks = _base_textures(rng, density, blank_walls)
    entities = []
    coarse_base = _base_solids(COARSE)
    for number, (name, label, solid) in enumerate(_base_solids(step_m), start=1):
        size = tuple(np.ptp(np.concatenate([p.vertices for p in solid]), axis=0).tolist())
        entities.append(
            Entity(
                number,
                name,
                label,
                True,
                None,
                None,
                True,
                size,
                np.eye(4),
                (coarse_base[number - 1][2],),
                solid,
            )
        )
    ids = {e.name: e.id for e in entities}
    models: dict[str, Model] = {}
    poses: dict[str, np.ndarray] = {}
    for spot in _plan_of(objects):
        # Every thing has its own stream, so that leaving one out does not change the others.
        stream = [seed, OBJECT_KINDS.index(spot.kind)]
        model = MAKERS[spot.kind](
            Workshop(np.random.default_rng(stream), 0.7 * step_m, density), f"{spot.kind}/"
        )
        coarse = MAKERS[spot.kind](Workshop(np.random.default_rng(stream), COARSE, 0.01), "")
        pose = _place(spot, np.random.default_rng([*stream, 1]), float(seed != 0), models, poses)
        models[spot.kind], poses[spot.kind] = model, pose
        looks |= model.textures
        hangs = spot.surface == "wall"
        entity = Entity(
            id=len(entities) + 1,
            name=spot.kind,
            label=model.label,
            base=False,
            relation="attached_to" if hangs else "supported_by",
            parent=ids[spot.parent],
            fixed=hangs or spot.kind in ("table", "shelf"),
            size=model.size,
            world_from_object=pose,
            solids=tuple(moved(part, pose) for part in coarse.parts),
            patches=tuple(patch for part in model.parts for patch in moved(part, pose)),
        )
        entities.append(entity)
        ids[spot.kind] = entity.id
    return Room(tuple(entities), looks)
