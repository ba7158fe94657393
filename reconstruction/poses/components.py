"""Connected components of the match graph, and pairs that may connect them.

Components arise where parts of a video show nothing in common: a cut, another room, a blocked view.
"""

import numpy as np

from reconstruction.poses.pairs import VerifiedPair

_MIN_PART = 3  # frames; smaller components are not searched for bridges
_MAX_BRIDGES = 150  # pairs tried between a component and the rest


def label_parts(count: int, pairs: list[VerifiedPair]) -> np.ndarray:
    """Label the connected components of frames under verified pairs: int (count,), 0 is the largest component."""
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
    """Propose pairs (row, later row, True) between each component but the largest and all other frames.

    Args:
        parts: (n,) from `label_parts`.
        scores: (n, n) overlap scores; the pairs with the highest are proposed.
        tried: pairs matched already, as of `choose_pairs`; those matched by all features are not proposed again.
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
