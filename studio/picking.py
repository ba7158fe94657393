"""Rays against the meshes of a scene: what a click hits."""

import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from registry.errors import BundleError
from registry.geometry import WORLD_FROM_GLTF, invert_rigid

_PARALLEL = 1e-12  # of a determinant in metres^2: the ray runs along the triangle


@dataclass(frozen=True)
class Geometry:
    """A triangle mesh in its owner's space, metres, +z up."""

    vertices: np.ndarray  # float64 (v, 3)
    faces: np.ndarray  # int (f, 3)


@dataclass(frozen=True)
class Hit:
    """First intersection of a ray."""

    owner: int
    distance: float  # metres along the ray
    point: np.ndarray  # float64 (3,) world space
    normal: np.ndarray  # float64 (3,) unit, world space, towards the ray's origin


def read_geometry(path: Path) -> Geometry:
    """Read vertices and faces of a bundle's .glb, converted from +y up to +z up.

    Raises:
        BundleError: the file cannot be read.
    """
    import trimesh

    try:
        mesh: Any = trimesh.load(path, force="mesh", process=False)
        vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces)
    except Exception as error:  # trimesh raises whatever its readers raise
        raise BundleError(f"{path}: cannot read it as a mesh ({error})") from error
    return Geometry(vertices @ WORLD_FROM_GLTF[:3, :3].T, faces)


class Pickable:
    """Meshes by owner, each read from its file when a ray first needs it."""

    def __init__(self) -> None:
        self._files: dict[int, Path] = {}
        self._read: dict[int, Geometry] = {}
        self._world_from_owner: dict[int, np.ndarray] = {}
        self._lock = threading.Lock()

    def add(self, owner: int, file: Path, world_from_owner: np.ndarray) -> None:
        """Add a mesh; its file is read later."""
        self._files[owner] = file
        self._world_from_owner[owner] = np.asarray(world_from_owner, np.float64)

    def move(self, owner: int, world_from_owner: np.ndarray) -> None:
        """Set the pose of a mesh."""
        self._world_from_owner[owner] = np.asarray(world_from_owner, np.float64)

    def geometry(self, owner: int) -> Geometry:
        """Return the mesh of an owner, in its own space."""
        with self._lock:
            if owner not in self._read:
                self._read[owner] = read_geometry(self._files[owner])
            return self._read[owner]

    def cast(
        self, origin: np.ndarray, direction: np.ndarray, hidden: frozenset[int] = frozenset()
    ) -> Hit | None:
        """Return the first front or back face that a ray (world space) meets; None: there is none.

        Args:
            origin: (3,) metres.
            direction: (3,) of any length.
            hidden: owners to ignore.
        """
        unit = np.asarray(direction, np.float64) / np.linalg.norm(direction)
        best: Hit | None = None
        for owner in self._files:
            if owner in hidden:
                continue
            mesh, world_from_owner = self.geometry(owner), self._world_from_owner[owner]
            owner_from_world = invert_rigid(world_from_owner)
            start = owner_from_world[:3, :3] @ np.asarray(origin, np.float64) + owner_from_world[:3, 3]
            found = first_hit(mesh, start, owner_from_world[:3, :3] @ unit)
            if found is not None and (best is None or found[0] < best.distance):
                normal = world_from_owner[:3, :3] @ found[1]
                point = np.asarray(origin, np.float64) + found[0] * unit
                best = Hit(owner, found[0], point, normal)
        return best


def first_hit(mesh: Geometry, origin: np.ndarray, direction: np.ndarray) -> tuple[float, np.ndarray] | None:
    """Intersect a ray with a mesh (Moeller and Trumbore 1997).

    Returns:
        Distance along the unit `direction` and the unit normal towards the origin, in the mesh's space; None: no hit.
    """
    if not _meets_box(mesh.vertices, origin, direction):
        return None
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    ab, ac = b - a, c - a
    p = np.cross(direction, ac)
    determinant = np.einsum("ij,ij->i", ab, p)
    usable = np.abs(determinant) > _PARALLEL
    inverse = 1.0 / np.where(usable, determinant, 1.0)
    t = origin - a
    u = np.einsum("ij,ij->i", t, p) * inverse
    q = np.cross(t, ab)
    v = (q @ direction) * inverse
    distance = np.einsum("ij,ij->i", ac, q) * inverse
    inside = usable & (u >= 0) & (v >= 0) & (u + v <= 1) & (distance > 0)
    if not inside.any():
        return None
    row = int(np.flatnonzero(inside)[np.argmin(distance[inside])])
    normal = np.cross(ab[row], ac[row])
    normal = normal / np.linalg.norm(normal)
    return float(distance[row]), -normal if normal @ direction > 0 else normal


def _meets_box(vertices: np.ndarray, origin: np.ndarray, direction: np.ndarray) -> bool:
    low, high = vertices.min(axis=0) - 1e-6, vertices.max(axis=0) + 1e-6
    with np.errstate(divide="ignore", invalid="ignore"):
        near, far = (low - origin) / direction, (high - origin) / direction
    first, last = np.fmin(near, far), np.fmax(near, far)
    return bool(np.nanmax(first) <= np.nanmin(last) and np.nanmin(last) >= 0)
