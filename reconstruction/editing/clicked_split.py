"""Cut one thing into parts: by a plane, or grown over its surface from clicks on each part."""

from collections.abc import Callable

import cv2
import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from reconstruction.core.mesh_graph import MeshGraph
from reconstruction.core.types import Surface

_COLOR_STEP, _FOLD_RAD = 5.0, 0.10  # CIELAB and inward angle across an edge that double its length
_FLAT_RAD = 0.08  # smaller folds are noise
_BRIDGE = (
    3.0  # pieces closer than this many vertex spacings are joined; a bridge counts four times its length
)


def grown_parts(surface: Surface, vertices: np.ndarray, seeds: list[list[int]]) -> np.ndarray:
    """Assign the vertices of a thing to the nearest seed over its surface; borders of color and concave folds are far.

    Args:
        surface: the whole surface.
        vertices: int (k,) the thing's vertices, ascending.
        seeds: for each part, vertices of the thing that belong to it.

    Returns:
        int (k,) the part of each vertex, counted from 0. Pieces that hang together with no seed go to the part whose
        vertices are nearest in space.
    """
    graph = MeshGraph.from_surface(surface)
    local = np.full(len(graph.points), -1, np.int64)
    local[vertices] = np.arange(len(vertices))
    edges = graph.edges_within(vertices)
    points = graph.points[vertices]
    near = cKDTree(points).query_pairs(_BRIDGE * graph.spacing_m, output_type="ndarray")
    bridges = vertices[near].reshape(-1, 2)
    cost = np.concatenate([_lengths(graph, edges), 4 * _lengths(graph, bridges)])
    a, b = local[np.concatenate([edges, bridges])].T
    # Where an edge of the mesh is also a short bridge, the edge counts: the first of equal pairs is kept.
    pair = np.minimum(a, b) * len(vertices) + np.maximum(a, b)
    _, first = np.unique(pair, return_index=True)
    size = (len(vertices), len(vertices))
    adjacency = coo_matrix((cost[first], (a[first], b[first])), shape=size).tocsr()
    starts = np.array([local[v] for part in seeds for v in part])
    part_of = np.full(len(vertices), -1, np.int64)
    owner = np.concatenate([np.full(len(part), k) for k, part in enumerate(seeds)])
    part_of[starts] = owner
    _, _, source = dijkstra(
        adjacency, directed=False, indices=starts, min_only=True, return_predecessors=True
    )
    reached = source >= 0
    out = np.where(reached, part_of[np.maximum(source, 0)], -1)
    if (out < 0).any():
        known = np.flatnonzero(out >= 0)
        out[out < 0] = out[known[cKDTree(points[known]).query(points[out < 0])[1]]]
    return out


def _lengths(graph: MeshGraph, edges: np.ndarray) -> np.ndarray:
    """Return the cost (e,) of going along edges: their length, more where the color changes or the surface folds in."""
    if not len(edges):
        return np.zeros(0)
    a, b = edges.T
    along = graph.points[b] - graph.points[a]
    length = np.maximum(np.linalg.norm(along, axis=1), 1e-6)
    color = np.linalg.norm(graph.lab[a] - graph.lab[b], axis=1) / _COLOR_STEP
    # Normals that lean towards each other: the surface is concave there.
    fold = ((graph.normals[a] - graph.normals[b]) * along).sum(axis=1) / length
    concave = np.maximum(fold - _FLAT_RAD, 0.0) / _FOLD_RAD
    return length * (1 + color**2 + concave**2)


def split_maps(
    maps: np.ndarray,
    seen_vertices: Callable[[int], np.ndarray],
    vertex_instance: np.ndarray,
    old: int,
    parts: list[int],
) -> None:
    """Give the pixels (n, h, w) of `old` to its parts, in place, as the surface drawn behind them says.

    Args:
        maps: ids per keyframe.
        seen_vertices: function from a keyframe's row to int (h, w), the surface vertex that each pixel shows, or -1.
        vertex_instance: int (v,) ids after the split.
        old: the id that was split.
        parts: ids of its parts.
    """
    for row in np.flatnonzero((maps == old).any(axis=(1, 2))):
        mine = maps[row] == old
        seen = seen_vertices(int(row))
        drawn = np.where(seen >= 0, vertex_instance[seen], 0)
        known = np.isin(drawn, parts)
        if not known.any():
            continue
        _, nearest = cv2.distanceTransformWithLabels(
            (~known).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
        )
        table = np.zeros(int(nearest.max()) + 1, maps.dtype)
        table[nearest[known]] = drawn[known]
        maps[row][mine] = table[nearest[mine]]
