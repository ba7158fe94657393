"""Make a fused mesh smaller: drop scattered pieces, merge vertices where the surface is flat."""

import numba
import numpy as np

from reconstruction.surface.extract import RawMesh
from reconstruction.surface.tsdf import BLOCK

# A block and its neighbours are flat where their vertices lie on a plane within the first number (metres, RMS). There 4
# cells a side are merged, or 2 where the colors of the block differ by more than the second (8-bit steps). Elsewhere 2
# or 4 are merged where a pixel covers more than the third, or twice that: no view saw finer things.
_STRENGTHS = (
    (0.001, 20, 1.5),
    (0.0015, 20, 1.0),
    (0.002, 20, 0.8),
    (0.003, 25, 0.65),
    (0.004, 30, 0.5),
    (0.006, 40, 0.4),
)


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
def _block_sums(block, points, colors, sums):  # pragma: no cover - compiled
    """Per block: count, sums of the coordinates, of their six products, of the colors and of their squares."""
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
    """Add up the first ten sums over each block and the 26 around it."""
    for n in range(len(blocks)):
        for x in range(max(0, blocks[n, 0] - 1), min(row.shape[0], blocks[n, 0] + 2)):
            for y in range(max(0, blocks[n, 1] - 1), min(row.shape[1], blocks[n, 1] + 2)):
                for z in range(max(0, blocks[n, 2] - 1), min(row.shape[2], blocks[n, 2] + 2)):
                    if row[x, y, z] >= 0:
                        for c in range(10):
                            out[n, c] += sums[row[x, y, z], c]


def _roughness(sums: np.ndarray) -> np.ndarray:
    """Return the RMS distance of points from their plane (n,), given their sums (n, 10)."""
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
    """Return how many cells (1, 2 or 4) a side may be merged: more where a block and its neighbours are flat.

    Args:
        cells: (n, 3) cells of the vertices that tell how flat a block is.
        points: (n, 3) the vertices in metres.
        colors: (n, 3) theirs.
        pixels: (n,) how many cells a pixel covers there.
        asked: (m, 3) cells whose level is asked for, in blocks that hold some of them.
        strength: row of _STRENGTHS; the later the fewer vertices are left.
    """
    home, query = cells // BLOCK, asked // BLOCK
    low = home.min(0)
    shape = tuple(home.max(0) - low + 1)
    used, block = np.unique(np.ravel_multi_index(tuple((home - low).T), shape), return_inverse=True)
    sums, wide = np.zeros((len(used), 16)), np.zeros((len(used), 10))
    # About a point of their own: the spread of millimetres must not drown in the squares of metres.
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
    """Return one number per cluster of level^3 cells; they grow along `axis` first. `span` bounds the cells."""
    corner = cells.astype(np.int64) // level[:, None] * level[:, None]
    second, third = (a for a in range(3) if a != axis)
    return (corner[:, axis] * int(span[second]) + corner[:, second]) * int(span[third]) + corner[:, third]


def merge_vertices(mesh: RawMesh, keys: np.ndarray) -> tuple[RawMesh, np.ndarray]:
    """Merge the first len(keys) vertices that share a key; return them without faces, and their keys, sorted."""
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
    """Merge vertices of one cluster of level^3 cells; faces that collapse vanish, so no crack can open."""
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
    """Merge vertices, flat parts first, until there are at most `max_vertices` where that is possible."""
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
