"""A generated room as the assets of a perfect reconstruction: true meshes at true poses, no hints, no textures."""

import numpy as np

from reconstruction.synthetic.room import Entity, Room
from reconstruction.types import (
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

_TEXTURE = np.full((2, 2, 3), 180, np.uint8)
_RANGES = PhysicalRanges((1.0, 1.0), (0.5, 0.5), (0.1, 0.1))


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
    visual = _mesh(entity, invert_rigid(entity.world_from_object))
    center = 0.5 * (visual.vertices.min(0) + visual.vertices.max(0)).astype(np.float64)
    physics = PhysicalAttributes("unknown", 500.0, 1.0, center, 0.01 * np.eye(3), 0.5, 0.1, _RANGES)
    return ObjectAsset(
        id=entity.id,
        label=entity.label,
        label_confidence=1.0,
        world_from_object=entity.world_from_object,
        visual=visual,
        collision=(),
        physics=physics,
        provenance=AssetProvenance("true", "none", "none", 1.0),
        views=np.zeros(0, np.int32),
        support_hint=0,
        attached_hint=False,
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
