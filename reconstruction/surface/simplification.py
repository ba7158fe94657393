"""Simplify a fused mesh: drop small connected components, decimate flat parts by vertex clustering."""

import numba
import numpy as np

from reconstruction.surface.extract import RawMesh
from reconstruction.surface.tsdf import BLOCK

# Rows: (planarity, color spread, pixel footprint), from weak to strong decimation. A block is flat if its vertices and
# those of its neighbours lie on a plane within `planarity` metres RMS. Clusters of a flat block have 4 cells a side, or
# 2 if its colors spread by more than `color spread` (8-bit steps). Clusters of other blocks have 2 or 4 cells a side if
# a pixel covers more than `pixel footprint` cells, or twice that.
_STRENGTHS = (
    (0.001, 20, 1.5),
    (0.0015, 20, 1.0),
    (0.002, 20, 0.8),
    (0.003, 25, 0.65),
    (0.004, 30, 0.5),
    (0.006, 40, 0.4),
)


def face_areas(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return the area (f,) of each triangle, in squared units of `vertices`."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)


def drop_small_components(mesh: RawMesh, min_area: float) -> tuple[RawMesh, int]:
    """Return the mesh without connected components below `min_area`, and the number of dropped components."""
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
def _block_sums(block, points, colors, sums):  # pragma: no cover - compiled
    """Accumulate per block (16,): count, coordinates (3), their products (6), colors (3), squared colors (3)."""
    for i in range(len(block)):
        b = block[i]
        sums[b, 0] += 1.0
        n = 4
        for a in range(3):
            sums[b, 1 + a] += points[i, a]
            for c in range(a, 3):
                sums[b, n] += points[i, a] * points[i, c]
                n += 1
            sums[b, 10 + a] += colors[i, a]
            sums[b, 13 + a] += float(colors[i, a]) ** 2


@numba.njit(cache=True)
def _with_neighbors(blocks, row, sums, out):  # pragma: no cover - compiled
    """Sum the first ten columns over each block and its 26 neighbours."""
    for n in range(len(blocks)):
        for x in range(max(0, blocks[n, 0] - 1), min(row.shape[0], blocks[n, 0] + 2)):
            for y in range(max(0, blocks[n, 1] - 1), min(row.shape[1], blocks[n, 1] + 2)):
                for z in range(max(0, blocks[n, 2] - 1), min(row.shape[2], blocks[n, 2] + 2)):
                    if row[x, y, z] >= 0:
                        for c in range(10):
                            out[n, c] += sums[row[x, y, z], c]


def _roughness(sums: np.ndarray) -> np.ndarray:
    """Return the RMS distance (n,) of the points of each block from their least-squares plane, from sums (n, 10)."""
    mean = sums[:, 1:4] / sums[:, :1]
    products = sums[:, [4, 5, 6, 5, 7, 8, 6, 8, 9]].reshape(-1, 3, 3) / sums[:, :1, None]
    spread = products - mean[:, :, None] * mean[:, None, :]
    return np.sqrt(np.maximum(np.linalg.eigvalsh(spread)[:, 0], 0.0))


def thinning_level(
    cells: np.ndarray,
    points: np.ndarray,
    colors: np.ndarray,
    pixels: np.ndarray,
    asked: np.ndarray,
    strength: int,
) -> np.ndarray:
    """Return the cluster size (m,) at cells: 1, 2 or 4 cells a side, larger in flat blocks.

    Args:
        cells: (n, 3) cells of the vertices that measure flatness.
        points: (n, 3) these vertices, metres.
        colors: (n, 3) their colors, 0 to 255.
        pixels: (n,) pixel footprint at each, in cells.
        asked: (m, 3) cells to answer for; their blocks must hold some of `cells`.
        strength: row of _STRENGTHS; later rows leave fewer vertices.
    """
    home, query = cells // BLOCK, asked // BLOCK
    low = home.min(0)
    shape = tuple(home.max(0) - low + 1)
    used, block = np.unique(np.ravel_multi_index(tuple((home - low).T), shape), return_inverse=True)
    sums, wide = np.zeros((len(used), 16)), np.zeros((len(used), 10))
    # Relative to one of the points, to avoid cancellation in the second moments.
    _block_sums(block.reshape(-1), points.astype(np.float64) - points[0], colors, sums)
    row = np.full(shape, -1, np.int32)
    row.reshape(-1)[used] = np.arange(len(used), dtype=np.int32)
    _with_neighbors(np.stack(np.unravel_index(used, shape), axis=1), row, sums, wide)
    tone = np.sqrt(np.maximum(sums[:, 13:] / sums[:, :1] - (sums[:, 10:13] / sums[:, :1]) ** 2, 0)).max(1)
    size = np.bincount(block.reshape(-1), np.minimum(pixels, 100.0)) / sums[:, 0]
    bound, tone_bound, unit = _STRENGTHS[strength]
    flat = _roughness(wide) < bound
    level = np.where(flat, np.where(tone < tone_bound, 4, 2), 1)
    level = np.maximum(level, np.where(size > 2 * unit, 4, np.where(size > unit, 2, 1)))
    return level[np.searchsorted(used, np.ravel_multi_index(tuple((query - low).T), shape))]


def cluster_keys(cells: np.ndarray, level: np.ndarray, axis: int, span: np.ndarray) -> np.ndarray:
    """Return a key (n,) for the cluster of level^3 cells of each cell (n, 3), ordered along `axis` first.

    `span` (3,) bounds the cells.
    """
    corner = cells.astype(np.int64) // level[:, None] * level[:, None]
    second, third = (a for a in range(3) if a != axis)
    return (corner[:, axis] * int(span[second]) + corner[:, second]) * int(span[third]) + corner[:, third]


def merge_vertices(mesh: RawMesh, keys: np.ndarray) -> tuple[RawMesh, np.ndarray]:
    """Average the first len(keys) vertices by key (n,); return a mesh without faces, and the sorted unique keys."""
    unique, first, group, count = np.unique(keys, return_index=True, return_inverse=True, return_counts=True)
    group, n = group.reshape(-1), len(keys)

    def mean(values: np.ndarray) -> np.ndarray:
        columns = [np.bincount(group, values[:n, a], len(count)) / count for a in range(values.shape[1])]
        return np.stack(columns, 1)

    normals = mean(mesh.normals)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    merged = RawMesh(
        mean(mesh.vertices).astype(np.float32), np.zeros((0, 3), np.int32), normals.astype(np.float32),
        np.clip(np.rint(mean(mesh.colors)), 0, 255).astype(np.uint8),
        mean(mesh.weights[:, None])[:, 0].astype(np.float32), mesh.cells[first],
        mean(mesh.pixels[:, None])[:, 0].astype(np.float32),
    )  # fmt: skip
    return merged, unique


def _merge(mesh: RawMesh, level: np.ndarray) -> RawMesh:
    """Merge the vertices of each cluster and drop the faces that collapse; this opens no cracks."""
    cells = mesh.cells - mesh.cells.min(0) // BLOCK * BLOCK
    keys = cluster_keys(cells, level, 0, cells.max(0) + 1)
    merged, unique = merge_vertices(mesh, keys)
    faces = np.searchsorted(unique, keys).astype(np.int32)[mesh.faces]
    alive = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 0] != faces[:, 2])
    faces = faces[alive]
    used = np.zeros(len(unique), bool)
    used[faces.reshape(-1)] = True
    return merged.subset(used, faces)


def thin(mesh: RawMesh, max_vertices: int) -> RawMesh:
    """Decimate by vertex clustering, flat parts first, towards at most `max_vertices`; this may not be reached."""
    if len(mesh.vertices) <= max_vertices:
        return mesh
    result = mesh
    for strength in range(len(_STRENGTHS)):
        result = _merge(
            mesh, thinning_level(mesh.cells, mesh.vertices, mesh.colors, mesh.pixels, mesh.cells, strength)
        )
        if len(result.vertices) <= max_vertices:
            return result
    flat = thinning_level(
        mesh.cells, mesh.vertices, mesh.colors, mesh.pixels, mesh.cells, len(_STRENGTHS) - 1
    )
    for size in (2, 4, 8):
        result = _merge(mesh, np.maximum(flat, size))
        if len(result.vertices) <= max_vertices:
            break
    return result
