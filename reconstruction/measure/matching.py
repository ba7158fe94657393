"""One-to-one matching of objects by the overlap of their boxes, and the scene graph after it."""

from collections.abc import Iterable, Sequence

import numpy as np


def box_iou(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the IoU (n, m) of axis-aligned boxes (n, 2, 3) and (m, 2, 3): lower and upper corners."""
    a, b = np.asarray(a, np.float64).reshape(-1, 2, 3), np.asarray(b, np.float64).reshape(-1, 2, 3)
    low = np.maximum(a[:, None, 0], b[None, :, 0])
    high = np.minimum(a[:, None, 1], b[None, :, 1])
    shared = np.prod(np.maximum(high - low, 0.0), axis=2)
    volumes_a, volumes_b = np.prod(a[:, 1] - a[:, 0], axis=1), np.prod(b[:, 1] - b[:, 0], axis=1)
    union = volumes_a[:, None] + volumes_b[None] - shared
    return np.where(union > 0, shared / np.maximum(union, 1e-300), 0.0)


def match(iou: np.ndarray, bound: float) -> list[tuple[int, int]]:
    """Pair rows with columns one to one so that the summed IoU of the pairs of at least `bound` is the greatest."""
    from scipy.optimize import linear_sum_assignment

    if not iou.size:
        return []
    gain = np.where(iou >= bound, iou, 0.0)
    rows, columns = linear_sum_assignment(-gain)
    return [(int(r), int(c)) for r, c in zip(rows, columns) if iou[r, c] >= bound]


EdgeTriple = tuple[object, str, object]  # (child, relation, parent)


def graph_f1(estimated: Iterable[EdgeTriple], true: Iterable[EdgeTriple]) -> float:
    """F1 of two sets of (child, relation, parent), between 0 and 1; 1 where both are empty."""
    estimated, true = set(estimated), set(true)
    if not estimated and not true:
        return 1.0
    return 2 * len(estimated & true) / (len(estimated) + len(true))


def match_base(estimated: Sequence, true: Sequence) -> dict[int, int]:
    """Say which true floor or wall each estimated one is: the nearest, of the same label where there is one.

    Args:
        estimated: items with `id`, `label`, `vertices` and `faces`, in the true world.
        true: items with `id`, `label` and `mesh`.

    Returns:
        Estimated id -> true id. Two estimated walls may be parts of the same true one.
    """
    from scipy.spatial import cKDTree

    from reconstruction.measure.surfaces import sample

    trees = {e.id: cKDTree(sample(e.mesh.vertices, e.mesh.faces, 20_000).points) for e in true}
    out = {}
    for item in estimated:
        candidates = [e for e in true if e.label == item.label] or list(true)
        points = sample(item.vertices, item.faces, 2_000).points
        if candidates and len(points):
            out[item.id] = min(candidates, key=lambda e: trees[e.id].query(points)[0].mean()).id
    return out
