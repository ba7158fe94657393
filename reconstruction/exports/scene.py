"""Convert a bundle to bodies with closed convex parts and a physically valid inertia, the input of all exporters."""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from registry import SceneBundle
from registry.errors import BundleError
from registry.primitives import Primitive
from registry.rigid_groups import moving_ids, welded_to
from registry.simulation import cookable_points, specs_from_bundle, standing_primitive

_LEAST_MOMENT = 1e-3  # lower bound of a principal moment over the largest one, as in registry/simulation.py


@dataclass(frozen=True)
class Hull:
    """A closed convex mesh with faces oriented outward."""

    vertices: np.ndarray  # float64 (v, 3) metres
    faces: np.ndarray  # int32 (f, 3)


@dataclass(frozen=True)
class ExportBody:
    """One object or base surface; meshes, center of mass and inertia in object space (base: world space)."""

    id: int
    label: str
    name: str  # unique, letters, digits and underscores, starts with a letter
    base: bool
    moves: bool
    weld: int | None  # id of the moving body that it is rigidly attached to
    relation: tuple[str, int] | None  # (relation, id of the parent) of the scene graph
    world_from_object: np.ndarray  # float64 (4, 4) rigid
    visual: Path  # textured .glb
    parts: tuple[Hull, ...]
    primitives: tuple[Primitive | None, ...]  # per part: the equivalent box or cylinder, or None
    mass_kg: float  # 0 for base surfaces
    center_of_mass: np.ndarray  # float64 (3,)
    inertia: np.ndarray  # float64 (3, 3) about the center of mass, object axes
    friction: float
    restitution: float


@dataclass(frozen=True)
class ExportScene:
    """All bodies of a scene: base surfaces, the backdrop if there is one, objects."""

    id: str
    revision: str
    bodies: tuple[ExportBody, ...]
    notes: tuple[str, ...]  # deviations from the bundle

    def body(self, key: int) -> ExportBody:
        """Look up a body by its id."""
        return next(body for body in self.bodies if body.id == key)


def read_scene(bundle: SceneBundle) -> ExportScene:
    """Read the bodies of a bundle.

    Raises:
        BundleError: a base surface has no collision slab, or a collision part has no volume.
    """
    scene = bundle.scene
    entries = {item["id"]: item for item in (*scene["base"], *scene["objects"])}
    moving, welds = moving_ids(bundle), welded_to(bundle)
    relations = {edge.child: (edge.relation, edge.parent) for edge in bundle.edges}
    bodies, notes = [], []
    for spec in specs_from_bundle(bundle):
        entry = entries[spec.id]
        parts = tuple(closed_part(points, spec.name) for points in spec.parts)
        name = safe_name(entry["label"], spec.id)
        inertia = np.zeros((3, 3))
        if not spec.base:
            wanted = spec.inertia if spec.inertia is not None else uniform_inertia(parts, spec.mass_kg)
            inertia, changed = possible_inertia(wanted)
            if changed:
                notes.append(f"{name}: its inertia is not physically valid; the nearest valid one is written")
        bodies.append(
            ExportBody(
                id=spec.id,
                label=entry["label"],
                name=name,
                base=spec.base,
                moves=spec.id in moving,
                weld=welds.get(spec.id),
                relation=relations.get(spec.id),
                world_from_object=np.asarray(spec.world_from_object, np.float64),
                visual=bundle.resolve(entry["mesh" if spec.base else "visual"]),
                parts=parts,
                primitives=tuple(None if spec.base else standing_primitive(points) for points in spec.parts),
                mass_kg=spec.mass_kg,
                center_of_mass=spec.center_of_mass,
                inertia=inertia,
                friction=spec.friction,
                restitution=spec.restitution,
            )
        )
    if bundle.backdrop is not None:
        bodies.insert(len(bundle.base), _backdrop_body(bundle.resolve(bundle.backdrop)))
    return ExportScene(scene["id"], bundle.revision, tuple(bodies), tuple(notes))


def _backdrop_body(visual: Path) -> ExportBody:
    """Return the backdrop as a fixed body without collision shape; its id 0 is no entity's."""
    return ExportBody(
        id=0, label="backdrop", name="backdrop_0", base=True, moves=False, weld=None, relation=None,
        world_from_object=np.eye(4), visual=visual, parts=(), primitives=(), mass_kg=0.0, center_of_mass=np.zeros(3),
        inertia=np.zeros((3, 3)), friction=0.0, restitution=0.0,
    )  # fmt: skip


def safe_name(label: str, key: int) -> str:
    """Return a name that is valid in XML, USD and Blender and unique by the id, such as `coffee_cup_12`."""
    words = re.sub(r"[^A-Za-z0-9]+", "_", label).strip("_")
    return f"{words if words[:1].isalpha() else f'thing_{words}'.rstrip('_')}_{key}"


def closed_part(points: np.ndarray, name: str) -> Hull:
    """Compute the convex hull of the points (v, 3) of a collision part, flat ones thickened as for PhysX.

    Raises:
        BundleError: the points are coplanar even then; `name` is the body's, for the message.
    """
    from scipy.spatial import ConvexHull, QhullError

    points = cookable_points(points)
    try:
        hull = ConvexHull(points)
    except QhullError as error:
        extents = np.ptp(points, axis=0)
        raise BundleError(f"'{name}': a collision part of extents {extents} m has no volume") from error
    number = np.full(len(points), -1, np.int32)
    number[hull.vertices] = np.arange(len(hull.vertices))
    corner = points[hull.simplices]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    inward = np.einsum("fk,fk->f", normal, hull.equations[:, :3]) < 0
    faces = np.where(inward[:, None], hull.simplices[:, ::-1], hull.simplices)
    return Hull(points[hull.vertices], number[faces])


def uniform_inertia(parts: tuple[Hull, ...], mass_kg: float) -> np.ndarray:
    """Compute the inertia (3, 3), kg m2, of parts of uniform density about their common center of mass."""
    import trimesh

    solids = [trimesh.Trimesh(part.vertices, part.faces, process=False) for part in parts]
    volume = sum(solid.volume for solid in solids)
    center = sum(solid.volume * solid.center_mass for solid in solids) / volume
    out = np.zeros((3, 3))
    for solid in solids:
        arm = solid.center_mass - center
        out += solid.moment_inertia + solid.volume * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    return out * mass_kg / volume


def possible_inertia(inertia: np.ndarray) -> tuple[np.ndarray, bool]:
    """Project an inertia (3, 3) to a physically valid one; also return whether it changed.

    Principal moments are raised to a lower bound and until they satisfy the triangle inequality.
    """
    symmetric = 0.5 * (inertia + inertia.T)
    moments, axes = np.linalg.eigh(symmetric)  # ascending
    least = max(_LEAST_MOMENT * moments[2], 1e-9)
    raised = np.maximum(moments, least)
    missing = raised[2] - raised[0] - raised[1]
    if missing > 0:
        raised[:2] += 0.5 * missing * (1 + 1e-6)
    if np.array_equal(raised, moments):
        return symmetric, False
    return (axes * raised) @ axes.T, True
