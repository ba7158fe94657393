"""Superpoints: oversegmentation of a mesh into small patches with similar normals and colors.

Greedy merging over mesh edges, from the smallest to the largest difference of normals and colors. Two patches merge if
their area-weighted mean normals and colors agree and their bounding box stays small. Means are weighted by area and
sizes are in metres, so that the result hardly depends on the density of the mesh.
"""

import numpy as np
from numba import njit

from reconstruction.core.mesh_graph import MeshGraph
from reconstruction.instances.colors import LIGHTNESS_WEIGHT

MAX_SIZE_M = 0.06  # largest diagonal of a patch's bounding box
_STRONG_ANGLE_DEG, _STRONG_COLOR = 35.0, 14.0  # edges with larger differences, in CIELAB, never merge patches
_MEAN_ANGLE_DEG, _MEAN_COLOR = 25.0, 10.0  # largest differences of the means of two patches
_CRUMB_M2 = 6e-5  # the mean normal of a smaller patch is unreliable: only its edges are tested


def superpoints(graph: MeshGraph, max_size_m: float = MAX_SIZE_M) -> np.ndarray:
    """Return the superpoint int32 (v,) of each vertex, numbered from 0 by first vertex."""
    count = len(graph.points)
    if count == 0:
        return np.zeros(0, np.int32)
    lab = np.ascontiguousarray(graph.lab, np.float64) * LIGHTNESS_WEIGHT
    normals = np.ascontiguousarray(graph.normals, np.float64)
    a, b = graph.edges[:, 0], graph.edges[:, 1]
    cosine = np.clip(np.einsum("ij,ij->i", normals[a], normals[b]), -1.0, 1.0)
    angle = np.degrees(np.arccos(cosine))
    color = np.linalg.norm(lab[a] - lab[b], axis=1)
    cost = np.maximum(angle / _STRONG_ANGLE_DEG, color / _STRONG_COLOR)
    order = np.argsort(cost, kind="stable")
    order = order[cost[order] <= 1.0]
    areas = np.maximum(graph.areas, 1e-12)
    roots = _grow(
        graph.edges, order, np.ascontiguousarray(graph.points, np.float64), normals, lab, areas,
        max_size_m**2, np.cos(np.radians(_MEAN_ANGLE_DEG)), _MEAN_COLOR**2, _CRUMB_M2,
    )  # fmt: skip
    return np.unique(roots, return_inverse=True)[1].reshape(-1).astype(np.int32)


@njit(cache=True)
def _root(parent, i):  # pragma: no cover - compiled
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@njit(cache=True)
def _grow(
    edges, order, points, normals, lab, areas, max_size2, min_cos, max_color2, crumb
):  # pragma: no cover - compiled
    """Return the root of each vertex's patch, by union-find: the smallest vertex in it."""
    count = points.shape[0]
    parent = np.arange(count)
    low, high = points.copy(), points.copy()
    area = areas.copy()
    direction, color = np.empty((count, 3)), np.empty((count, 3))
    for i in range(count):
        for k in range(3):
            direction[i, k] = normals[i, k] * areas[i]
            color[i, k] = lab[i, k] * areas[i]
    for relaxed in range(2):  # the second pass merges the patches below `crumb` m2
        for e in order:
            a, b = _root(parent, edges[e, 0]), _root(parent, edges[e, 1])
            if a == b or (relaxed == 1 and min(area[a], area[b]) > crumb):
                continue
            size2, dot, aa, bb, far2 = 0.0, 0.0, 0.0, 0.0, 0.0
            for k in range(3):
                side = max(high[a, k], high[b, k]) - min(low[a, k], low[b, k])
                size2 += side * side
                dot += direction[a, k] * direction[b, k]
                aa += direction[a, k] ** 2
                bb += direction[b, k] ** 2
                far2 += (color[a, k] / area[a] - color[b, k] / area[b]) ** 2
            if size2 > max_size2:
                continue
            if relaxed == 0 and (dot < min_cos * np.sqrt(aa * bb) or far2 > max_color2):
                continue
            if b < a:
                a, b = b, a
            parent[b] = a
            area[a] += area[b]
            for k in range(3):
                low[a, k], high[a, k] = min(low[a, k], low[b, k]), max(high[a, k], high[b, k])
                direction[a, k] += direction[b, k]
                color[a, k] += color[b, k]
    for i in range(count):
        parent[i] = _root(parent, i)
    return parent
