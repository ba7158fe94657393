"""A generated room -> the assets of a perfect reconstruction: true meshes, masses, poses and collision primitives."""

import numpy as np

from reconstruction.assembly.base import convex_part
from reconstruction.core.types import (
    AssetProvenance,
    AssetSet,
    BaseAsset,
    Edge,
    ObjectAsset,
    PhysicalAttributes,
    PhysicalRanges,
    TexturedMesh,
)
from registry.geometry import invert_rigid, transform_points
from synthetic.checks import convex_pieces
from synthetic.room import Entity, Room

_TEXTURE = np.full((2, 2, 3), 180, np.uint8)
_DENSITY_KG_M3, _FRICTION, _RESTITUTION = 600.0, 0.45, 0.1
_MIN_MASS_KG = 5e-3


def true_assets(room: Room) -> AssetSet:
    """Return the assets of a room; ids are those of its entities."""
    return AssetSet(
        tuple(_base_asset(room, entity) for entity in room.base), tuple(map(_object_asset, room.objects))
    )


def true_edges(room: Room) -> dict[int, Edge]:
    """Return what the room's graph is, by child."""
    return {e.id: Edge(e.id, str(e.relation), int(e.parent), 1.0, "true") for e in room.objects}


def _mesh(entity: Entity, mesh_from_world: np.ndarray) -> TexturedMesh:
    mesh = entity.mesh()
    vertices = transform_points(mesh_from_world, np.asarray(mesh.vertices))
    return TexturedMesh(
        vertices.astype(np.float32),
        np.asarray(mesh.faces, np.int32),
        np.zeros((len(vertices), 2), np.float32),
        _TEXTURE,
    )


def _object_asset(entity: Entity) -> ObjectAsset:
    object_from_world = invert_rigid(entity.world_from_object)
    return ObjectAsset(
        id=entity.id,
        label=entity.label,
        label_confidence=1.0,
        world_from_object=entity.world_from_object,
        visual=_mesh(entity, object_from_world),
        collision=tuple(convex_part(transform_points(object_from_world, p)) for p in convex_pieces(entity)),
        physics=_physics(entity, object_from_world),
        provenance=AssetProvenance("true", "none", "true", 1.0),
        views=np.zeros(0, np.int32),
        support_hint=0,
        attached_hint=False,
    )


def _physics(entity: Entity, object_from_world: np.ndarray) -> PhysicalAttributes:
    mesh = entity.mesh()
    mass = max(_DENSITY_KG_M3 * float(mesh.volume), _MIN_MASS_KG)
    turn = object_from_world[:3, :3]
    inertia = turn @ mesh.moment_inertia @ turn.T * (mass / float(mesh.volume))
    center = transform_points(object_from_world, mesh.center_mass[None])[0]
    ranges = PhysicalRanges((mass, mass), (_FRICTION, _FRICTION), (_RESTITUTION, _RESTITUTION))
    return PhysicalAttributes(
        "wood", _DENSITY_KG_M3, mass, center, 0.5 * (inertia + inertia.T), _FRICTION, _RESTITUTION, ranges
    )


def _base_asset(room: Room, entity: Entity) -> BaseAsset:
    """Floor and walls are slabs; the plane is that of the face towards the room."""
    west, east, south, north = room.extent
    plane = {
        "floor": (0.0, 0.0, 1.0, 0.0),
        "wall_north": (0.0, -1.0, 0.0, north),
        "wall_south": (0.0, 1.0, 0.0, -south),
        "wall_west": (1.0, 0.0, 0.0, -west),
        "wall_east": (-1.0, 0.0, 0.0, east),
    }[entity.name]
    return BaseAsset(entity.id, entity.label, np.array(plane), _mesh(entity, np.eye(4)), True)
