"""Conversion of a placed, generated mesh to one closed manifold solid."""

import numpy as np

from reconstruction.assets.completion import CompletedField
from reconstruction.assets.config import AssetsConfig
from reconstruction.assets.generation.meshes import GeneratedMesh
from reconstruction.assets.solid import (
    Solid,
    extract,
    lighten,
    lightened,
    taubin,
    to_manifold,
    without_crumbs,
)

_CELLS_MORE = 1.4  # finer than the embedded completion, as a generated mesh has no noise
_SMOOTHING = 3  # iterations
_LEAST_M3 = 1e-7
_WALL = 1.0  # half thickness of the surface that stops the flood, voxels


def closed_solid(mesh: GeneratedMesh, config: AssetsConfig, budget: int) -> Solid | None:
    """Return a mesh in metres as a closed solid of about `budget` faces; None where nothing solid is left.

    A closed manifold keeps its surface if decimation keeps it closed. Otherwise the space outside is flood-filled on a
    grid, which closes holes and thickens sheets.
    """
    own = to_manifold(_joined(mesh.vertices, mesh.faces))
    if own is not None:
        own = without_crumbs(own)
    if own is not None and len(own.faces) > budget:
        own = lightened(own, budget)
    if own is not None:
        return own if own.volume > _LEAST_M3 else None
    voxel = _voxel(mesh, config)
    body = extract(flooded(mesh, voxel, config.min_thickness_m))
    if body is None:
        return None
    body = taubin(body, _SMOOTHING, np.abs(body.vertices[:, 2] - body.vertices[:, 2].min()) < 0.3 * voxel)
    body = to_manifold(lighten(body, budget, 0.3 * voxel))
    return body if body is not None and body.volume > _LEAST_M3 else None


def flooded(mesh: GeneratedMesh, voxel_m: float, thickness_m: float) -> CompletedField:
    """Return a signed distance field by flood filling the space outside a mesh.

    Near the surface, its normals decide the sign. Where the flood enters through a hole, a shell of `thickness_m`
    remains, inwards from the surface.
    """
    from scipy.ndimage import binary_dilation, label
    from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]

    thickness_m = max(thickness_m, 2.0 * voxel_m)
    reach = int(np.ceil(thickness_m / voxel_m)) + 1
    pad = reach + 2
    origin = mesh.points.min(axis=0) - pad * voxel_m
    shape = np.ceil((mesh.points.max(axis=0) - origin) / voxel_m).astype(np.int64) + pad
    crust = np.zeros(shape, bool)
    crust[tuple(np.floor((mesh.points - origin) / voxel_m).astype(np.int64).T)] = True
    near = np.asarray(binary_dilation(crust, np.ones((3, 3, 3), bool), iterations=reach), bool)
    centers = origin + (np.argwhere(near) + 0.5) * voxel_m
    distance, nearest = cKDTree(mesh.points).query(centers)
    front = np.einsum("nk,nk->n", centers - mesh.points[nearest], mesh.normals[nearest]) > 0
    wall = np.zeros(shape, bool)
    wall[near] = distance < _WALL * voxel_m
    bodies = label(~wall)[0]  # pyright: ignore[reportIndexIssue]
    air = bodies == bodies[0, 0, 0]
    rim = np.asarray(binary_dilation(air & ~near), bool)[near]
    if rim.any() and front[rim].mean() < 0.5:  # the mesh is inside out
        front = ~front
    field = np.where(air, 1.0, -1.0) * reach * voxel_m
    field[near] = np.where(front, distance, np.maximum(-distance, distance - thickness_m))
    # Space that the flood does not reach is solid: pages of a book, shells within shells.
    reached = np.asarray(binary_dilation(air, iterations=int(np.ceil(_WALL)) + 1), bool)
    field = np.where((field > 0) & ~reached, -0.5 * voxel_m, field)
    limit = 3.0 * voxel_m
    return CompletedField(origin, voxel_m, np.clip(field, -limit, limit).astype(np.float32), ())


def _voxel(mesh: GeneratedMesh, config: AssetsConfig) -> float:
    size = np.maximum(mesh.extents, 1e-3)
    finest = float(size.max()) / (_CELLS_MORE * config.cells_along_longest)
    return max(finest, float((size.prod() / config.max_voxels) ** (1 / 3)), 0.5 * config.voxel_min_m)


def _joined(vertices: np.ndarray, faces: np.ndarray) -> Solid:
    """Merge vertices at the same position, which readers split at texture seams."""
    step = 1e-6 * max(float(np.ptp(vertices, axis=0).max()), 1e-9)
    _, first, index = np.unique(
        np.round(vertices / step).astype(np.int64), axis=0, return_index=True, return_inverse=True
    )
    faces = index.ravel()[faces]
    whole = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    return Solid(vertices[first], faces[whole].astype(np.int32))
