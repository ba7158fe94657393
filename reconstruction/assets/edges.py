"""Repair of closed meshes so that every edge has exactly two faces, also after vertices are merged by position.

Decimation can make two sheets touch: a manifold by vertex numbers has two edges at one place. Once a file reader merges
these vertices, four faces share an edge, and the mesh is not watertight. Such an edge is split for one pair of faces.
"""

import numpy as np

from reconstruction.assets.solid import Solid, compact, manifold_of

_MAX_PASSES = 12
_AT = (0.5, 0.4, 0.6)  # position of the split along an edge, by pass


def with_simple_edges(solid: Solid) -> Solid:
    """Merge vertices at one position (single precision) and split edges that more than two faces share.

    The surface does not move. A solid that cannot be repaired is returned unchanged.
    """
    vertices, index = np.unique(solid.vertices.astype(np.float32), axis=0, return_inverse=True)
    points = vertices.astype(np.float64)
    faces = _without_folds(index.reshape(-1)[solid.faces])
    for turn in range(_MAX_PASSES):
        pairs = _doubled(faces)
        if pairs is None:
            return solid
        if not pairs:
            mended = compact(Solid(points, faces.astype(np.int32)))
            return solid if manifold_of(mended) is None else mended
        points, faces = _split(points, faces, pairs, _AT[turn % len(_AT)])
    return solid


def _without_folds(faces: np.ndarray) -> np.ndarray:
    """Drop degenerate faces (f, 3) and pairs of opposite faces with the same corners."""
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    corners, group = np.unique(np.sort(faces, axis=1), axis=0, return_inverse=True)
    group = group.reshape(-1)
    first = np.argmin(faces, axis=1)
    turned = np.take_along_axis(faces, (first[:, None] + np.arange(3)) % 3, axis=1)
    even = turned[:, 1] < turned[:, 2]
    count = np.zeros((len(corners), 2), np.int64)
    np.add.at(count, (group, even.astype(int)), 1)
    dropped = count.min(axis=1)
    if not dropped.any():
        return faces
    order = np.lexsort((np.arange(len(faces)), even, group))
    key = 2 * group[order] + even[order]
    rank = np.arange(len(order)) - np.searchsorted(key, key)
    kept = np.ones(len(faces), bool)
    kept[order[rank < dropped[group[order]]]] = False
    return faces[kept]


def _doubled(faces: np.ndarray) -> list[tuple[int, int, int, int]] | None:
    """Return (a, b, face, face) for one pair of faces of each edge with more than two; None for open meshes."""
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    owner = np.repeat(np.arange(len(faces)), 3)
    low, high = np.minimum(start, end), np.maximum(start, end)
    _, group, uses = np.unique(np.column_stack([low, high]), axis=0, return_inverse=True, return_counts=True)
    group = group.reshape(-1)
    forward = start < end
    if (np.bincount(group, weights=np.where(forward, 1.0, -1.0)) != 0).any():
        return None
    out: list[tuple[int, int, int, int]] = []
    taken: set[int] = set()
    for number in np.flatnonzero(uses > 2):
        half = np.flatnonzero(group == number)
        one, other = half[forward[half]][-1], half[~forward[half]][-1]
        pair = int(owner[one]), int(owner[other])
        if pair[0] in taken or pair[1] in taken or pair[0] == pair[1]:
            continue
        taken.update(pair)
        out.append((int(low[one]), int(high[one]), *pair))
    return out


def _split(
    points: np.ndarray, faces: np.ndarray, pairs: list[tuple[int, int, int, int]], at: float
) -> tuple[np.ndarray, np.ndarray]:
    """Put a vertex on each edge, and connect the two given faces to it."""
    added, more = [], []
    faces = faces.copy()
    for a, b, *both in pairs:
        middle = len(points) + len(added)
        added.append(((1 - at) * points[a] + at * points[b]).astype(np.float32))
        for face in both:
            old = faces[face]
            k = next(i for i in range(3) if {int(old[i]), int(old[(i + 1) % 3])} == {a, b})
            first, second, third = old[k], old[(k + 1) % 3], old[(k + 2) % 3]
            faces[face] = (first, middle, third)
            more.append((middle, second, third))
    return np.concatenate([points, np.array(added, np.float64)]), np.concatenate([faces, np.array(more)])
