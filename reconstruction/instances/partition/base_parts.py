"""Propose parts of floor, walls and ceiling as things: a labeled partition in, the same with more clusters out.

A picture, a poster or a rug has the shape of the plane that it is on, so that its superpoints are labeled "base". The
affinities, which know colors and image edges, often part it from the plane all the same.
"""

import numpy as np

from reconstruction.instances.partition.graph import LABELS
from reconstruction.instances.partition.multicut import multicut

_LARGEST_M2 = 2.0  # of a part that is proposed; a door has 1.7
_THING, _BASE = LABELS.index("thing"), LABELS.index("base")


def with_parts_of_base(
    pairs: np.ndarray, affinity: np.ndarray, area: np.ndarray, label: np.ndarray, cluster: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Label clusters of the base "thing" that a multicut without labels parts from it.

    Args:
        pairs: int (e, 2) edges of the superpoint graph.
        affinity: float (e,) log-odds that both ends are one object.
        area: float (n,) of each superpoint, square metres.
        label: int32 (n,) row in LABELS of each superpoint.
        cluster: int32 (n,) its cluster, from 0.

    Returns:
        Label and cluster of each superpoint. The largest part, and those too large for a thing, stay base.
    """
    base = np.flatnonzero(label == _BASE)
    if not len(base):
        return label, cluster
    number = np.full(len(label), -1)
    number[base] = np.arange(len(base))
    inside = (number[pairs] >= 0).all(axis=1)
    part = multicut(len(base), number[pairs[inside]], affinity[inside])
    size = np.bincount(part, weights=area[base])
    proposed = size < min(_LARGEST_M2, size.max())
    parts = base[proposed[part]]
    label, cluster = label.copy(), cluster.copy()
    label[parts] = _THING
    cluster[parts] = int(cluster.max()) + 1 + part[proposed[part]]
    return label, np.unique(cluster, return_inverse=True)[1].astype(np.int32)
