"""Every edge of a closed mesh between exactly two faces, also for readers that know vertices by their positions.

A mesh can be a closed manifold by its vertex numbers and yet have two of its edges at one place, where decimation made
two sheets touch. Once vertices at one place are one (the mesh was written to a file, with its texture's seams), four
faces meet there, and a reader finds it not watertight. Such an edge is split for one of the two pairs of faces.
"""

import numpy as np

from reconstruction.assets.solid import Solid, compact, manifold_of

_MAX_PASSES = 12
_AT = (0.5, 0.4, 0.6)  # where along an edge it is split, in the order of passes


def with_simple_edges(solid: Solid) -> Solid:
    """Return the solid with vertices at one place (in single precision) made one and no edge shared by four faces.

    Its surface stays where it is. A solid that cannot be mended comes back as it was.
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
    """Drop faces (f, 3) that are no triangle any more, and pairs of faces that lie back to back."""
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
    """Return (a, b, face, face) of edges shared by more than two faces, for one pair of each; None for open meshes."""
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    owner = np.repeat(np.arange(len(faces)), 3)
    low, high = np.minimum(start, end), np.maximum(start, end)
    _, group, uses = np.unique(np.column_stack([low, high]), axis=0, return_inverse=True, return_counts=True)
    group = group.reshape(-1)
    forward = start < end
    if (np.bincount(group, weights=np.where(forward, 1.0, -1.0)) != 0).any():
        return None
    out, taken = [], set()
    for number in np.flatnonzero(uses > 2):
        half = np.flatnonzero(group == number)
        one, other = half[forward[half]][-1], half[~forward[half]][-1]
        if owner[one] in taken or owner[other] in taken or owner[one] == owner[other]:
            continue
        taken |= {owner[one], owner[other]}
        out.append((int(low[one]), int(high[one]), int(owner[one]), int(owner[other])))
    return out


def _split(
    points: np.ndarray, faces: np.ndarray, pairs: list[tuple[int, int, int, int]], at: float
) -> tuple[np.ndarray, np.ndarray]:
    """Put a vertex on each edge, and let the two faces given for it meet there."""
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
