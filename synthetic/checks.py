"""Check that a generated room is possible: nothing overlaps, contacts are exact, everything stands by itself."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from registry.geometry import invert_rigid, transform_points
from synthetic.room import Entity, Room

if TYPE_CHECKING:
    import trimesh

MAX_OVERLAP_M = 1e-4
MAX_CONTACT_ERROR_M = 1e-4
_DENSITY_KG_M3 = 600.0
_FRICTION = 0.5


@dataclass(frozen=True)
class RoomCheck:
    """What `validate_room` found."""

    problems: tuple[str, ...]
    """One line per fault; empty: the room is possible."""
    physics: dict[str, Any]
    """`registry.report_card.physics_report` of the true meshes; all but what hangs is free to move."""

    @property
    def ok(self) -> bool:
        """Return whether nothing is wrong."""
        return not self.problems


def validate_room(room: Room, duration_s: float = 10.0) -> RoomCheck:
    """Check a room with the true meshes.

    Args:
        room: The room.
        duration_s: How long everything must stand.

    Returns:
        The faults found: overlaps deeper than 0.1 mm, contacts farther than 0.1 mm off, things that do not stand
        (moved 2 cm or turned 5 degrees, contract section 4).
    """
    from registry.report_card import physics_report

    meshes = {e.id: e.mesh() for e in room.entities}
    problems = [f"{e.name}: its mesh is not closed" for e in room.entities if not meshes[e.id].is_volume]
    for a, b, depth in overlaps(room, meshes):
        problems.append(f"{a} and {b} overlap by {depth * 1e3:.2f} mm")
    by_id = {e.id: e for e in room.entities}
    for entity in room.objects:
        parent = by_id[entity.parent]
        if entity.relation == "supported_by":
            share = carried_share(meshes[entity.id], meshes[parent.id])
            if share < 0.5:
                problems.append(f"{entity.name}: {share:.0%} of its bottom touches {parent.name}")
        elif wall_gap(meshes[entity.id], meshes[parent.id]) > MAX_CONTACT_ERROR_M:
            problems.append(f"{entity.name} does not touch {parent.name}")
    report = physics_report(bodies(room, meshes), duration_s=duration_s)
    problems += [
        f"{o['name']} does not stand: moved {o['moved_m'] * 1e3:.1f} mm, turned {o['turned_deg']:.1f} degrees"
        for o in report["objects"]
        if not o["stable"]
    ]
    return RoomCheck(tuple(problems), report)


def overlaps(room: Room, meshes: dict[int, "trimesh.Trimesh"]) -> Iterator[tuple[str, str, float]]:
    """Yield pairs of things, base included, whose common volume is deeper than 0.1 mm on average."""
    import trimesh

    for number, b in enumerate(room.entities):
        for a in room.entities[:number]:
            if a.base and b.base:
                continue  # walls and floor share their corners
            low = np.maximum(meshes[a.id].bounds[0], meshes[b.id].bounds[0])
            high = np.minimum(meshes[a.id].bounds[1], meshes[b.id].bounds[1])
            if np.any(high - low < MAX_OVERLAP_M):
                continue
            common = trimesh.boolean.intersection([meshes[a.id], meshes[b.id]], engine="manifold")
            volume = _volume(common)
            if volume > 1e-10 and volume / (common.area / 2) > MAX_OVERLAP_M:
                yield a.name, b.name, float(volume / (common.area / 2))


def _volume(mesh: "trimesh.Trimesh") -> float:
    """Return the volume, also of the slivers that touching things have in common."""
    t = mesh.triangles
    return abs(float(np.einsum("ij,ij->", t[:, 0], np.cross(t[:, 1], t[:, 2])))) / 6


def carried_share(child: "trimesh.Trimesh", parent: "trimesh.Trimesh") -> float:
    """Return which share of a thing's level bottom lies on a level face of its support, to 0.1 mm."""
    bottom = child.bounds[0, 2]
    below = (child.face_normals[:, 2] < -0.99) & (np.abs(child.triangles[:, :, 2] - bottom).max(1) < 1e-5)
    if not below.any():
        return 0.0
    rng = np.random.default_rng(0)
    faces = np.flatnonzero(below)
    chosen = rng.choice(faces, 400, p=child.area_faces[faces] / child.area_faces[faces].sum())
    weights = rng.dirichlet((1.0, 1.0, 1.0), 400)
    points = np.einsum("ik,ikj->ij", weights, child.triangles[chosen])[:, :2]
    level = (parent.face_normals[:, 2] > 0.99) & (
        np.abs(parent.triangles[:, :, 2] - bottom).max(1) < MAX_CONTACT_ERROR_M
    )
    inside = np.zeros(len(points), bool)
    for triangle in parent.triangles[level][:, :, :2]:
        edge = np.roll(triangle, -1, axis=0) - triangle
        away = points[:, None] - triangle
        inside |= np.all(edge[:, 0] * away[..., 1] - edge[:, 1] * away[..., 0] >= -1e-9, axis=1)
    return float(inside.mean())


def wall_gap(child: "trimesh.Trimesh", wall: "trimesh.Trimesh") -> float:
    """Return the distance in metres between a thing's three nearest corners and a wall, an upright slab."""
    low, high = wall.bounds
    outside = np.maximum(np.maximum(low - child.vertices, child.vertices - high), 0.0)
    return float(np.sort(np.linalg.norm(outside, axis=1))[2])


def convex_pieces(entity: Entity) -> tuple[np.ndarray, ...]:
    """Return convex pieces (v, 3) in world space."""
    if entity.pieces:
        return entity.pieces
    return tuple(np.concatenate([patch.vertices for patch in solid]) for solid in entity.solids)


def bodies(room: Room, meshes: dict[int, "trimesh.Trimesh"]) -> list:
    """Return `registry.simulation.BodySpec`s of the true room: base and what hangs are held, all else is free."""
    from registry.simulation import BASE_FRICTION, BASE_RESTITUTION, BodySpec

    out = []
    for entity in room.entities:
        object_from_world = invert_rigid(entity.world_from_object)
        mesh = meshes[entity.id]
        out.append(
            BodySpec(
                id=entity.id,
                name=entity.name,
                parts=tuple(transform_points(object_from_world, p) for p in convex_pieces(entity)),
                mass_kg=max(_DENSITY_KG_M3 * float(mesh.volume), 1e-3),
                center_of_mass=transform_points(object_from_world, mesh.center_mass[None])[0],
                inertia=None,
                friction=BASE_FRICTION if entity.base else _FRICTION,
                restitution=BASE_RESTITUTION,
                world_from_object=entity.world_from_object,
                dynamic=not entity.base and entity.relation == "supported_by",
                base=entity.base,
            )
        )
    return out
