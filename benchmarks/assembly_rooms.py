"""Generated rooms as a reconstruction might hand them to assembly: true shapes and relations, poses a little off."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from reconstruction.assembly.base import convex_part
from reconstruction.synthetic.checks import convex_pieces
from reconstruction.synthetic.procedural import RoomSpec, build_procedural_room
from reconstruction.synthetic.room import Entity
from reconstruction.types import (
    AssetProvenance,
    AssetSet,
    BaseAsset,
    Edge,
    ObjectAsset,
    PhysicalAttributes,
    PhysicalRanges,
    SceneGraph,
    TexturedMesh,
)
from registry.geometry import invert_rigid, rigid, transform_points

if TYPE_CHECKING:
    import trimesh

SHIFT_M, TILT_DEG, YAW_DEG = (
    0.004,
    1.0,
    2.0,
)  # 1-sigma of what is off: each axis, about level axes, about the vertical
_DENSITY_KG_M3, _FRICTION, _RESTITUTION = 600.0, 0.45, 0.1


@dataclass(frozen=True)
class AssemblyTask:
    """What assembly is given, and where things belong."""

    assets: AssetSet
    graph: SceneGraph
    true_poses: dict[int, np.ndarray]  # world_from_object (4, 4)


def room_task(seed: int, objects: int) -> AssemblyTask:
    """Return a generated room with stacks and containers whose objects' poses are off by some millimetres."""
    room = build_procedural_room(RoomSpec(seed=seed, objects=objects, step_m=0.3))
    rng = np.random.default_rng([seed, objects])
    middle = np.concatenate([e.mesh().vertices for e in room.base]).mean(axis=0)
    base = tuple(_base(entity, middle) for entity in room.base)
    made = tuple(_object(entity, rng) for entity in room.objects)
    edges = tuple(Edge(e.id, e.relation, e.parent, 1.0, "true") for e in room.objects)
    true = {e.id: e.world_from_object for e in room.objects}
    return AssemblyTask(AssetSet(base, made), SceneGraph(edges), true)


def _base(entity: Entity, middle: np.ndarray) -> BaseAsset:
    mesh = entity.mesh()
    axis = int(np.argmin(mesh.extents))
    side = 1.0 if middle[axis] > mesh.bounds[:, axis].mean() else -1.0
    plane = np.zeros(4)
    plane[axis] = side
    plane[3] = -side * (mesh.bounds[1, axis] if side > 0 else mesh.bounds[0, axis])
    return BaseAsset(entity.id, entity.label, plane, _looks(mesh.vertices, mesh.faces), True)


def _object(entity: Entity, rng: np.random.Generator) -> ObjectAsset:
    mesh = entity.mesh()
    object_from_world = invert_rigid(entity.world_from_object)
    mass = max(_DENSITY_KG_M3 * float(mesh.volume), 5e-3)
    turn = entity.world_from_object[:3, :3].T
    inertia = turn @ mesh.moment_inertia @ turn.T * (mass / float(mesh.volume))
    center = transform_points(object_from_world, mesh.center_mass[None])[0]
    ranges = PhysicalRanges((mass, mass), (_FRICTION, _FRICTION), (_RESTITUTION, _RESTITUTION))
    physics = PhysicalAttributes(
        "wood", _DENSITY_KG_M3, mass, center, 0.5 * (inertia + inertia.T), _FRICTION, _RESTITUTION, ranges
    )
    return ObjectAsset(
        id=entity.id,
        label=entity.label,
        label_confidence=1.0,
        world_from_object=_disturbed(entity.world_from_object, rng),
        visual=_looks(transform_points(object_from_world, mesh.vertices), mesh.faces),
        collision=tuple(convex_part(transform_points(object_from_world, p)) for p in convex_pieces(entity)),
        physics=physics,
        provenance=AssetProvenance("true", "none", "true", 1.0),
        views=np.zeros(0, np.int32),
        support_hint=int(entity.parent),
        attached_hint=entity.relation == "attached_to",
    )


def _disturbed(pose: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    about = np.radians(rng.normal(size=3) * [TILT_DEG, TILT_DEG, YAW_DEG])
    angle = max(float(np.linalg.norm(about)), 1e-12)
    x, y, z = about / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    turn = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    return rigid(turn @ pose[:3, :3], pose[:3, 3] + SHIFT_M * rng.normal(size=3))


def _looks(vertices: np.ndarray, faces: "trimesh.caching.TrackedArray") -> TexturedMesh:
    uvs = np.zeros((len(vertices), 2), np.float32)
    return TexturedMesh(
        np.asarray(vertices, np.float32), np.asarray(faces, np.int32), uvs, np.zeros((2, 2, 3), np.uint8)
    )
