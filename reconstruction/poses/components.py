"""Parts of a video that share no pictures with each other: a cut, another room, a blocked view."""

import numpy as np

from reconstruction.poses.pairs import VerifiedPair

_MIN_PART = 3  # frames; fewer are not worth a search
_MAX_BRIDGES = 150  # pairs tried between two parts


def label_parts(count: int, pairs: list[VerifiedPair]) -> np.ndarray:
    """Return the part (count,) of each frame: frames joined by a chain of pairs; 0 is the largest part."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    rows = np.array([pair.rows for pair in pairs], int).reshape(-1, 2)
    graph = coo_array((np.ones(len(rows)), (rows[:, 0], rows[:, 1])), shape=(count, count))
    _, label = connected_components(graph, directed=False)
    sizes = np.bincount(label)
    rank = np.empty(len(sizes), int)
    rank[np.argsort(-sizes, kind="stable")] = np.arange(len(sizes))
    return rank[label]


def propose_bridges(
    parts: np.ndarray, scores: np.ndarray, tried: list[tuple[int, int, bool]]
) -> list[tuple[int, int, bool]]:
    """Return pairs (row, later row, True) between each larger part and the rest, most alike first.

    Args:
        parts: (n,) from `label_parts`.
        scores: (n, n) how much frames look alike.
        tried: pairs that were matched already; those matched by all features are not proposed again.
    """
    done = np.zeros_like(scores, bool)
    for i, j, near in tried:
        done[i, j] = near
    wanted: set[tuple[int, int]] = set()
    for part in np.flatnonzero(np.bincount(parts) >= _MIN_PART)[1:]:
        across = np.triu((parts[:, None] == part) != (parts[None] == part), 1) & ~done
        rows, columns = np.nonzero(across & (scores > 0))
        best = np.argsort(-scores[rows, columns], kind="stable")[:_MAX_BRIDGES]
        wanted |= set(zip(rows[best].tolist(), columns[best].tolist()))
    return [(i, j, True) for i, j in sorted(wanted)]
