"""Make a fused mesh smaller: drop scattered pieces, merge vertices where the surface is flat."""

import numba
import numpy as np

from reconstruction.surface.extract import RawMesh
from reconstruction.surface.tsdf import BLOCK


def face_areas(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return the area (f,) of each triangle."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)


def drop_small_components(mesh: RawMesh, min_area: float) -> tuple[RawMesh, int]:
    """Return the mesh without connected pieces of less area, and how many were dropped."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    n, f = len(mesh.vertices), mesh.faces
    graph = coo_matrix(
        (np.ones(2 * len(f), np.int8), (np.r_[f[:, 0], f[:, 1]], np.r_[f[:, 1], f[:, 2]])), shape=(n, n)
    )
    count, label = connected_components(graph, directed=False)
    area = np.bincount(label[f[:, 0]], face_areas(mesh.vertices, f), count)
    keep = area >= min_area
    return mesh.subset(keep[label], f), int(count - keep.sum())


@numba.njit(cache=True)
def _block_statistics(block, normals, positions, colors, sums):  # pragma: no cover - compiled
    for i in range(len(block)):
        b = block[i]
        sums[b, 0] += 1.0
        for a in range(3):
            sums[b, 1 + a] += normals[i, a]
            sums[b, 4 + a] += colors[i, a]
            sums[b, 7 + a] += float(colors[i, a]) ** 2


def _thinning_level(mesh: RawMesh, strength: int) -> np.ndarray:
    """Return per vertex how many cells (1, 2 or 4) a side may be merged: more where block and neighbours are flat."""
    from scipy.ndimage import maximum_filter

    home = mesh.cells // BLOCK
    home = home - home.min(0)
    shape = tuple(home.max(0) + 1)
    row = np.ravel_multi_index(tuple(home.T), shape)
    used, block = np.unique(row, return_inverse=True)
    sums = np.zeros((len(used), 10))
    _block_statistics(block.reshape(-1), mesh.normals, mesh.vertices, mesh.colors, sums)
    mean = sums[:, 1:] / sums[:, :1]
    bend = 1.0 - np.linalg.norm(mean[:, 0:3], axis=1)
    tone = np.sqrt(np.maximum(mean[:, 6:9] - mean[:, 3:6] ** 2, 0)).max(1)
    # An edge near a block's border bends the neighbour too: a block is as rough as the roughest beside it.
    grid = np.zeros(shape, np.float32)
    grid.reshape(-1)[used] = bend
    rough = maximum_filter(grid, 3).reshape(-1)[used]
    level = np.ones(len(used), np.int32)
    level[rough < (0.02, 0.02, 0.05)[strength]] = 2
    if strength >= 1:
        level[(rough < (0, 0.01, 0.02)[strength]) & (tone < (0, 12, 30)[strength])] = 4
    return level[block.reshape(-1)]


def _merge(mesh: RawMesh, level: np.ndarray) -> RawMesh:
    """Merge vertices of one cluster of level^3 cells; faces that collapse vanish, so no crack can open."""
    cluster = mesh.cells // level[:, None]
    low, span = cluster.min(0), np.ptp(cluster, axis=0).astype(np.int64) + 1
    cluster = (cluster - low).astype(np.int64)
    key = ((cluster[:, 0] * span[1] + cluster[:, 1]) * span[2] + cluster[:, 2]) * 8 + level
    _, group, count = np.unique(key, return_inverse=True, return_counts=True)
    group = group.reshape(-1)

    def mean(values: np.ndarray) -> np.ndarray:
        columns = [np.bincount(group, values[:, a], len(count)) / count for a in range(values.shape[1])]
        return np.stack(columns, 1)

    vertices, normals = mean(mesh.vertices.astype(np.float64)), mean(mesh.normals)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    faces = group[mesh.faces].astype(np.int32)
    alive = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 0] != faces[:, 2])
    faces = faces[alive]
    first = np.full(len(count), len(group), np.int64)
    np.minimum.at(first, group, np.arange(len(group)))
    merged = RawMesh(
        vertices.astype(np.float32), faces, normals.astype(np.float32),
        np.clip(np.rint(mean(mesh.colors)), 0, 255).astype(np.uint8),
        mean(mesh.weights[:, None])[:, 0].astype(np.float32), mesh.cells[first],
    )  # fmt: skip
    used = np.zeros(len(count), bool)
    used[faces.reshape(-1)] = True
    return merged.subset(used, faces)


def thin(mesh: RawMesh, max_vertices: int) -> RawMesh:
    """Merge vertices, flat parts first, until there are at most `max_vertices` where that is possible."""
    if len(mesh.vertices) <= max_vertices:
        return mesh
    result = mesh
    for strength in range(3):
        result = _merge(mesh, _thinning_level(mesh, strength))
        if len(result.vertices) <= max_vertices:
            return result
    for size in (2, 3, 4, 6, 8):
        level = np.maximum(_thinning_level(mesh, 2), size)
        result = _merge(mesh, level)
        if len(result.vertices) <= max_vertices:
            break
    return result
