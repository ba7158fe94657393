"""Compiled loops of the instances stage; imported only where they are needed."""

import numpy as np
from numba import njit


@njit(cache=True)
def _root(parent, i):  # pragma: no cover - compiled
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@njit(cache=True)
def grow_patches(links, weights, count, scale, minimum):  # pragma: no cover - compiled
    """Felzenszwalb and Huttenlocher's graph segmentation; `links` (e, 2) sorted by `weights`; root per node."""
    parent = np.arange(count)
    size = np.ones(count, np.int64)
    inner = np.zeros(count)
    for e in range(links.shape[0]):
        a, b = _root(parent, links[e, 0]), _root(parent, links[e, 1])
        if a == b:
            continue
        if weights[e] <= min(inner[a] + scale / size[a], inner[b] + scale / size[b]):
            parent[b] = a
            size[a] += size[b]
            inner[a] = weights[e]
    for e in range(links.shape[0]):
        a, b = _root(parent, links[e, 0]), _root(parent, links[e, 1])
        if a != b and (size[a] < minimum or size[b] < minimum):
            parent[b] = a
            size[a] += size[b]
    roots = np.empty(count, np.int64)
    for i in range(count):
        roots[i] = _root(parent, i)
    return roots


@njit(cache=True)
def step_along(indptr, indices, points, at, direction):  # pragma: no cover - compiled
    """From each vertex `at` step to the neighbor that lies farthest along `direction`, or stay."""
    out = at.copy()
    for i in range(at.shape[0]):
        best = 0.0
        for k in range(indptr[at[i]], indptr[at[i] + 1]):
            j = indices[k]
            ahead = 0.0
            for c in range(3):
                ahead += (points[j, c] - points[at[i], c]) * direction[i, c]
            if ahead > best:
                best = ahead
                out[i] = j
    return out
