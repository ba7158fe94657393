"""Voxelize the convex solids of a bundle into a boolean occupancy grid. NumPy and SciPy only.

Robots and cameras are placed with this grid, before the simulator is built.
"""

import functools
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from registry import SceneBundle
from registry.bundle import BundleBase
from registry.geometry import WORLD_FROM_GLTF, matrix_from_quat, quat_from_matrix, transform_points
from registry.simulation import read_obj_points
from simrecon_envs.errors import SceneAssetsMissing

SLAB_THICKNESS_M = 0.10  # of the box behind a wall or floor without collision parts


@dataclass(frozen=True)
class ConvexSolid:
    """A convex part in world space."""

    owner: int  # id of the object or base entity
    label: str
    vertices: np.ndarray  # float64 (v, 3)
    half_spaces: np.ndarray  # float64 (f, 4): inside where n . x + d <= 0

    @functools.cached_property
    def lower(self) -> np.ndarray:
        """Return the minimum corner (3,) of its bounding box."""
        return self.vertices.min(axis=0)

    @functools.cached_property
    def upper(self) -> np.ndarray:
        """Return the maximum corner (3,) of its bounding box."""
        return self.vertices.max(axis=0)


@dataclass(frozen=True)
class BaseSlab:
    """A box behind a plane of the room, for a base entity without collision parts; world space."""

    center: np.ndarray  # float64 (3,)
    quat_wxyz: np.ndarray  # float64 (4,) world_from_box
    half_size: np.ndarray  # float64 (3,); z is the plane's normal


def read_obj_vertices(path: Path) -> np.ndarray:
    """Return the vertices (v, 3) of a Wavefront file.

    Raises:
        SceneAssetsMissing: It cannot be read or has fewer than four vertices.
    """
    try:
        return read_obj_points(path)
    except (OSError, ValueError) as error:
        raise SceneAssetsMissing(f"collision mesh {path}: cannot be read ({error})") from error


def convex_solid(owner: int, label: str, vertices: np.ndarray) -> ConvexSolid:
    """Return the convex hull of a vertex cloud (v, 3) in world space; a flat cloud is thickened to 1 mm."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        hull = ConvexHull(vertices)
    except QhullError:
        offsets = 0.0005 * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
        vertices = (vertices[:, None] + offsets).reshape(-1, 3)
        hull = ConvexHull(vertices)
    return ConvexSolid(owner, label, vertices[hull.vertices], np.unique(hull.equations.round(9), axis=0))


def base_slab(plane: np.ndarray, vertices: np.ndarray) -> BaseSlab:
    """Return the box whose front face lies on the plane (4,) and covers the mesh's vertices (v, 3)."""
    normal = plane[:3] / np.linalg.norm(plane[:3])
    helper = np.eye(3)[np.argmin(np.abs(normal))]
    x_axis = np.cross(helper, normal) / np.linalg.norm(np.cross(helper, normal))
    world_from_box = np.stack([x_axis, np.cross(normal, x_axis), normal], axis=1)
    local = vertices @ world_from_box
    low, high = local.min(axis=0), local.max(axis=0)
    front = -plane[3] / np.linalg.norm(plane[:3])
    half = np.array([*(high - low)[:2] / 2, SLAB_THICKNESS_M / 2])
    center = np.array([*(low + high)[:2] / 2, front - SLAB_THICKNESS_M / 2])
    return BaseSlab(world_from_box @ center, quat_from_matrix(world_from_box), np.maximum(half, 0.005))


def slab_corners(slab: BaseSlab) -> np.ndarray:
    """Return the corners (8, 3) of a slab in world space."""
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    return (signs * slab.half_size) @ matrix_from_quat(slab.quat_wxyz).T + slab.center


def glb_vertices(path: Path) -> np.ndarray:
    """Return the vertices (v, 3) of a .glb, converted to +z up."""
    import trimesh

    scene: Any = trimesh.load(path, force="scene", process=False)
    return transform_points(WORLD_FROM_GLTF, np.asarray(scene.to_mesh().vertices))


def base_parts(bundle: SceneBundle, base: BundleBase) -> list[np.ndarray]:
    """Return the convex parts (v, 3) of a base entity in world space, or a box behind its plane."""
    if base.collision:
        return [read_obj_vertices(bundle.resolve(path)) for path in base.collision]
    assert base.plane is not None  # the structure has collision parts
    return [slab_corners(base_slab(base.plane, glb_vertices(bundle.resolve(base.mesh))))]


def scene_solids(bundle: SceneBundle) -> list[ConvexSolid]:
    """Return the convex parts of all base entities and objects of a bundle, in world space."""
    solids = []
    for base in bundle.base:
        solids += [convex_solid(base.id, base.label, part) for part in base_parts(bundle, base)]
    for item in bundle.objects:
        for path in item.collision:
            cloud = transform_points(item.world_from_object, read_obj_vertices(bundle.resolve(path)))
            solids.append(convex_solid(item.id, item.label, cloud))
    return solids


class OccupancyGrid:
    """Boolean voxel grid of a box in world space: cells within `margin_m` of a solid."""

    def __init__(
        self,
        solids: list[ConvexSolid],
        lower: np.ndarray,
        upper: np.ndarray,
        cell_m: float = 0.025,
        margin_m: float = 0.01,
    ) -> None:
        """Fill the cells whose centre is within the margin plus half a cell diagonal of a solid."""
        self.lower = np.asarray(lower, np.float64)
        self.cell_m = cell_m
        shape = np.maximum(np.ceil((np.asarray(upper) - self.lower) / cell_m).astype(int), 1)
        self.filled = np.zeros(tuple(shape), bool)
        grow = margin_m + cell_m * np.sqrt(3) / 2
        for solid in solids:
            low = np.floor((solid.lower - grow - self.lower) / cell_m).astype(int).clip(0, shape)
            high = np.ceil((solid.upper + grow - self.lower) / cell_m).astype(int).clip(0, shape)
            if (high <= low).any():
                continue
            centers = [self.lower[a] + (np.arange(low[a], high[a]) + 0.5) * cell_m for a in range(3)]
            # The distance to a half-space is a sum of terms in x, y and z: evaluate it by broadcasting.
            inside = np.ones(tuple(high - low), bool)
            for nx, ny, nz, d in solid.half_spaces:
                level = (nx * centers[0])[:, None, None] + (ny * centers[1])[None, :, None]
                inside &= level + (nz * centers[2] + d)[None, None, :] <= grow
            self.filled[low[0] : high[0], low[1] : high[1], low[2] : high[2]] |= inside

    def add_points(self, points: np.ndarray) -> None:
        """Fill the cells that contain any of the world points (n, 3)."""
        cell = np.floor((np.asarray(points) - self.lower) / self.cell_m).astype(int)
        cell = cell[((cell >= 0) & (cell < self.filled.shape)).all(axis=1)]
        self.filled[cell[:, 0], cell[:, 1], cell[:, 2]] = True

    def occupied(self, points: np.ndarray) -> np.ndarray:
        """Return whether world points (..., 3) lie in filled cells (...,); false outside the box."""
        cell = np.floor((np.asarray(points) - self.lower) / self.cell_m).astype(int)
        inside: Any = ((cell >= 0) & (cell < self.filled.shape)).all(axis=-1)
        cell = np.where(inside[..., None], cell, 0)
        return self.filled[cell[..., 0], cell[..., 1], cell[..., 2]] & inside

    def visible(self, eye: np.ndarray, points: np.ndarray, keep_off_m: float = 0.06) -> np.ndarray:
        """Return whether segments from `eye` (3,) to points (n, 3) are free, except the last `keep_off_m` (n,)."""
        rays = np.asarray(points, np.float64) - eye
        lengths = np.linalg.norm(rays, axis=1)
        steps = int(np.ceil(lengths.max(initial=0.1) / self.cell_m)) + 1
        share = np.linspace(0, 1, steps)[None, :, None]
        ends = np.clip(1 - keep_off_m / np.maximum(lengths, 1e-9), 0, 1)[:, None, None]
        hidden: Any = self.occupied(eye + rays[:, None, :] * share * ends).any(axis=1)
        return ~hidden
