"""Match objects one to one by IoU, match base surfaces, and score scene graphs."""

from collections.abc import Iterable, Sequence

import numpy as np
from scipy.spatial import KDTree

IOU_BOUNDS = (0.25, 0.5)  # CONTRACT sections 4 and 5
EdgeTriple = tuple[object, object, object]  # (child, relation, parent)


def box_iou(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Compute the IoU (n, m) of axis-aligned boxes (n, 2, 3) and (m, 2, 3), given by lower and upper corner."""
    a, b = np.asarray(a, np.float64).reshape(-1, 2, 3), np.asarray(b, np.float64).reshape(-1, 2, 3)
    low = np.maximum(a[:, None, 0], b[None, :, 0])
    high = np.minimum(a[:, None, 1], b[None, :, 1])
    shared = np.prod(np.maximum(high - low, 0.0), axis=2)
    volumes_a, volumes_b = np.prod(a[:, 1] - a[:, 0], axis=1), np.prod(b[:, 1] - b[:, 0], axis=1)
    union = volumes_a[:, None] + volumes_b[None] - shared
    return np.where(union > 0, shared / np.maximum(union, 1e-300), 0.0)


def match(iou: np.ndarray, bound: float) -> list[tuple[int, int]]:
    """Return the one-to-one pairs (row, column) with IoU >= `bound` that maximize the summed IoU (Hungarian)."""
    from scipy.optimize import linear_sum_assignment

    if not iou.size:
        return []
    gain = np.where(iou >= bound, iou, 0.0)
    rows, columns = linear_sum_assignment(-gain)
    return [(int(r), int(c)) for r, c in zip(rows, columns) if iou[r, c] >= bound]


def graph_f1(estimated: Iterable[EdgeTriple], true: Iterable[EdgeTriple]) -> float:
    """Return the F1 score, 0 to 1, of two sets of edges; 1 if both are empty."""
    estimated, true = set(estimated), set(true)
    if not estimated and not true:
        return 1.0
    return 2 * len(estimated & true) / (len(estimated) + len(true))


def match_base(estimated: Sequence, true: Sequence) -> dict[int, int]:
    """Assign each estimated base surface the nearest true one, of the same label if there is any.

    Args:
        estimated: items with `id`, `label`, `vertices` and `faces`, in the true world.
        true: items with `id`, `label` and `mesh`.

    Returns:
        Estimated id -> true id; not one to one, since two estimated walls may be parts of one true wall.
    """
    from reconstruction.measure.surfaces import sample

    trees = {e.id: KDTree(sample(e.mesh.vertices, e.mesh.faces, 20_000).points) for e in true}
    out = {}
    for item in estimated:
        candidates = [e for e in true if e.label == item.label] or list(true)
        points = sample(item.vertices, item.faces, 2_000).points
        if candidates and len(points):
            out[item.id] = min(candidates, key=lambda e: trees[e.id].query(points)[0].mean()).id
    return out
