"""Inference of gradient-boosted regression trees (Friedman, Annals of Statistics 2001) from plain arrays.

`priors` fits the trees with LightGBM, which is not needed to run them.
"""

from dataclasses import dataclass, fields

import numpy as np
from numba import njit


@dataclass(frozen=True)
class Boosted:
    """Trees as concatenated arrays; a child below 0 is leaf `-1 - child` of the same tree."""

    root: np.ndarray  # int32 (t + 1,) row of each tree's first node, and the number of nodes
    first_leaf: np.ndarray  # int32 (t,) row of each tree's first leaf
    feature: np.ndarray  # uint8 (n,) that a node compares
    threshold: np.ndarray  # float32 (n,) values up to it go left
    left: np.ndarray  # int8 (n,) child, counted from the tree's first node
    right: np.ndarray  # int8 (n,)
    value: np.ndarray  # float32 (l,) of leaves
    features: np.ndarray  # int32 () number of features

    def __call__(self, rows: np.ndarray) -> np.ndarray:
        """Return the raw score float32 (m,), log-odds, of features float32 (m, F)."""
        if rows.shape[1] != int(self.features):
            raise ValueError(f"trees for {int(self.features)} features got {rows.shape[1]}")
        rows = np.ascontiguousarray(rows, np.float32)
        return _summed(
            rows, self.root, self.first_leaf, self.feature, self.threshold, self.left, self.right, self.value
        )

    @classmethod
    def named(cls, arrays: dict[str, np.ndarray]) -> "Boosted":
        """Return trees from arrays by field name.

        Raises:
            KeyError: an array is missing.
        """
        return cls(**{f.name: np.asarray(arrays[f.name]) for f in fields(cls)})

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the arrays by field name."""
        return {f.name: np.asarray(getattr(self, f.name)) for f in fields(self)}


@njit(cache=True)
def _summed(rows, root, first_leaf, feature, threshold, left, right, value):  # pragma: no cover - compiled
    out = np.zeros(len(rows), np.float32)
    for i in range(len(rows)):
        total = 0.0
        for t in range(len(first_leaf)):
            node = 0 if root[t + 1] > root[t] else -1
            while node >= 0:
                at = root[t] + node
                node = left[at] if rows[i, feature[at]] <= threshold[at] else right[at]
            total += value[first_leaf[t] - 1 - node]
        out[i] = total
    return out
