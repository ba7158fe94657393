"""Segment the horizontal up-facing parts of a surface into patches of one height."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from reconstruction.core.mesh_graph import MeshGraph, pieces


def horizontal_levels(graph: MeshGraph, chosen: np.ndarray, min_area_m2: float) -> list[np.ndarray]:
    """Return the connected level up-facing patches among vertices `chosen` (sorted indices), as vertex indices.

    Patches are split by height; those below `min_area_m2` are dropped.
    """
    flat = chosen[graph.normals[chosen, 2] > 0.85]
    graph = replace(graph, edges=graph.edges_within(flat))  # filtering all edges for each patch would be slow
    levels: list[np.ndarray] = []
    for piece in pieces(graph, flat):
        if graph.areas[piece].sum() >= min_area_m2:
            levels.extend(_split_by_height(graph, piece))
    return [piece for piece in levels if graph.areas[piece].sum() >= min_area_m2]


def joined_levels(levels: list[np.ndarray], of_one: Callable[[int, int], bool]) -> list[np.ndarray]:
    """Merge levels i < j where `of_one(i, j)`, transitively; return the sorted vertices of each group."""
    count = len(levels)
    joined = [[i < j and of_one(i, j) for j in range(count)] for i in range(count)]
    groups, group = connected_components(csr_array(np.reshape(joined, (count, count))), directed=False)
    return [np.sort(np.concatenate([levels[i] for i in np.flatnonzero(group == g)])) for g in range(groups)]


def _split_by_height(graph: MeshGraph, piece: np.ndarray) -> list[np.ndarray]:
    """Split a connected up-facing patch at the peaks of its height histogram."""
    z = graph.points[piece, 2]
    if np.percentile(z, 98) - np.percentile(z, 2) < 0.02:
        return [piece]
    step = 0.004
    bounds = np.arange(z.min() - 2 * step, z.max() + 3 * step, step)
    histogram = np.histogram(z, bounds, weights=graph.areas[piece])[0]
    smooth = np.convolve(histogram, [0.25, 0.5, 0.25], "same")
    peaks = [
        i
        for i in range(1, len(smooth) - 1)
        if smooth[i] >= smooth[i - 1] and smooth[i] > smooth[i + 1] and smooth[i] * 3 > 0.002
    ]
    peaks.sort(key=lambda i: -smooth[i])
    kept: list[int] = []
    for peak in peaks:
        if all(abs(peak - other) * step > 0.015 for other in kept):
            kept.append(peak)
    out = []
    for peak in kept:
        near = piece[np.abs(z - (bounds[peak] + 0.5 * step)) < 0.008]
        out.extend(pieces(graph, near))
    return out
