"""Split one object into parts, from clicks on each part: by learned affinities, within a superpoint by geodesics."""

from collections.abc import Callable

import cv2
import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]

from reconstruction.core.mesh_graph import MeshGraph
from reconstruction.core.types import Surface
from reconstruction.instances.partition.seeded import Affinities

_COLOR_STEP, _FOLD_RAD = 5.0, 0.10  # CIELAB difference and concave angle that double the cost of an edge
_FLAT_RAD = 0.08  # smaller concave angles are noise
_BRIDGE = 3.0  # vertices within this many spacings are connected across gaps, at four times the cost


def clicked_parts(
    surface: Surface, affinities: Affinities, vertices: np.ndarray, seeds: list[list[int]]
) -> np.ndarray:
    """Assign each vertex of an object to the part that it belongs to by the affinities that also cut the surface.

    A superpoint with clicks on several parts is cut by `grown_parts` first. Vertices that no borders connect with a
    click get the part of the nearest other vertex in space.

    Args:
        surface: the whole surface.
        affinities: of its superpoints.
        vertices: int (k,) vertices of the object, ascending.
        seeds: for each part, vertices of the object that belong to it.

    Returns:
        Part of each vertex int (k,), from 0.
    """
    region = affinities.graph.region.astype(np.int64)
    inside = np.zeros(len(region), bool)
    inside[vertices] = True
    fresh = affinities.graph.count
    for number in {int(region[v]) for part in seeds for v in part}:
        hit = [[v for v in part if affinities.graph.region[v] == number] for part in seeds]
        clicked = [points for points in hit if points]
        if len(clicked) > 1:
            rows = np.flatnonzero(inside & (region == number))
            region[rows] = fresh + grown_parts(surface, rows, clicked)
            fresh += len(clicked)
    out = affinities.seeded(vertices, region, seeds)
    return _filled(out, np.asarray(surface.vertices, np.float64)[vertices])


def _filled(part: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return parts (k,) with those below 0 replaced by that of the nearest of the other points (k, 3)."""
    out, known = part.copy(), np.flatnonzero(part >= 0)
    if len(known) < len(part):
        out[part < 0] = part[known[cKDTree(points[known]).query(points[part < 0])[1]]]
    return out


def grown_parts(surface: Surface, vertices: np.ndarray, seeds: list[list[int]]) -> np.ndarray:
    """Assign each vertex of an object to the seed with the shortest path over the surface (Dijkstra's algorithm).

    Edges with a color step or a concave fold are expensive, so that parts meet there. Vertices without a path to a seed
    get the part of the nearest other vertex in space.

    Args:
        surface: the whole surface.
        vertices: int (k,) vertices of the object, ascending.
        seeds: for each part, vertices of the object that belong to it.

    Returns:
        Part of each vertex int (k,), from 0.
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
    # A mesh edge may also be a bridge: the first of equal pairs, the edge, is kept.
    pair = np.minimum(a, b) * len(vertices) + np.maximum(a, b)
    _, first = np.unique(pair, return_index=True)
    size = (len(vertices), len(vertices))
    adjacency = coo_matrix((cost[first], (a[first], b[first])), shape=size).tocsr()
    starts = np.array([local[v] for part in seeds for v in part])
    part_of = np.full(len(vertices), -1, np.int64)
    part_of[starts] = np.concatenate([np.full(len(part), k) for k, part in enumerate(seeds)])
    source = dijkstra(adjacency, False, starts, return_predecessors=True, min_only=True)[2]
    return _filled(np.where(source >= 0, part_of[np.maximum(source, 0)], -1), points)


def _lengths(graph: MeshGraph, edges: np.ndarray) -> np.ndarray:
    """Return the cost (e,) of edges (e, 2): their length, larger at color steps and concave folds."""
    if not len(edges):
        return np.zeros(0)
    a, b = edges.T
    along = graph.points[b] - graph.points[a]
    length = np.maximum(np.linalg.norm(along, axis=1), 1e-6)
    color = np.linalg.norm(graph.lab[a] - graph.lab[b], axis=1) / _COLOR_STEP
    # Normals that lean towards each other: a concave fold.
    fold = ((graph.normals[a] - graph.normals[b]) * along).sum(axis=1) / length
    concave = np.maximum(fold - _FLAT_RAD, 0.0) / _FOLD_RAD
    return length * (1 + color**2 + concave**2)


def split_maps(
    maps: np.ndarray, seen_vertices: Callable[[int], np.ndarray], vertex_instance: np.ndarray, old: int,
    parts: list[int],
) -> None:  # fmt: skip
    """Relabel the pixels of a split object, in place, by the nearest pixel at which a part is rendered.

    Args:
        maps: ids (n, h, w) of keyframes.
        seen_vertices: returns the surface vertex int (h, w) at each pixel of a keyframe, by its row; -1 = none.
        vertex_instance: int (v,) ids after the split.
        old: the id that was split.
        parts: ids of the parts.
    """
    for row in np.flatnonzero((maps == old).any(axis=(1, 2))):
        mine = maps[row] == old
        seen = seen_vertices(int(row))
        drawn = np.where(seen >= 0, vertex_instance[seen], 0)
        known = np.isin(drawn, parts)
        if not known.any():
            continue
        unknown = (~known).astype(np.uint8)
        nearest = np.asarray(
            cv2.distanceTransformWithLabels(unknown, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)[1], np.int32
        )  # fmt: skip
        table = np.zeros(int(nearest.max()) + 1, maps.dtype)
        table[nearest[known]] = drawn[known]
        maps[row][mine] = table[nearest[mine]]
