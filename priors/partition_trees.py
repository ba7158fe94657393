"""Boosted trees of the learned cut: which clusters are of one thing, and how well a proposal is a thing.

They are fitted with LightGBM (`pip install "simrecon[training]"`) and kept as arrays.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from reconstruction.instances.partition.boosting import Boosted
from registry.errors import EnvironmentMissing

_COMMON = {
    "num_leaves": 31, "bagging_freq": 1, "verbose": -1, "num_threads": 1, "deterministic": True, "force_col_wise": True,
}  # fmt: skip
PAIRS = _COMMON | {
    "objective": "binary", "learning_rate": 0.05, "min_data_in_leaf": 200, "feature_fraction": 0.3,
    "bagging_fraction": 0.5, "lambda_l2": 10.0,
}  # fmt: skip
PROPOSALS = _COMMON | {
    "objective": "cross_entropy", "learning_rate": 0.04, "min_data_in_leaf": 60, "feature_fraction": 0.4,
    "bagging_fraction": 0.6, "lambda_l2": 225.0,
}  # fmt: skip
DUPLICATES = _COMMON | {
    "objective": "cross_entropy", "learning_rate": 0.05, "min_data_in_leaf": 200, "feature_fraction": 0.5,
    "bagging_fraction": 0.6, "lambda_l2": 50.0,
}  # fmt: skip
_LEAVES_OF_FEW_ROWS = 20  # at the most, where there are too few rows for leaves of the usual size


def fit_trees(
    rows: np.ndarray, target: np.ndarray, weight: np.ndarray, settings: dict[str, Any], rounds: int, seed: int
) -> Boosted:
    """Fit trees to features float32 (m, F) and targets float (m,) in [0, 1]; the score is a log-odds.

    Raises:
        EnvironmentMissing: LightGBM is not installed.
    """
    try:
        import lightgbm
    except ImportError as error:
        raise EnvironmentMissing(
            'Boosted trees are fitted with LightGBM: pip install "simrecon[training]"'
        ) from error
    data = lightgbm.Dataset(rows, target, weight=weight, free_raw_data=True)
    least = min(settings["min_data_in_leaf"], len(rows) // _LEAVES_OF_FEW_ROWS)
    settings = settings | {"seed": seed, "min_data_in_leaf": max(least, 1)}
    return arrays_of(lightgbm.train(settings, data, rounds).dump_model())


def arrays_of(dumped: dict[str, Any]) -> Boosted:
    """Return the trees of LightGBM's `dump_model`."""
    root, first_leaf, nodes, values = [0], [], [], []
    for tree in dumped["tree_info"]:
        own: list[tuple[int, float, int, int]] = []
        first_leaf.append(len(values))
        _walk(tree["tree_structure"], own, values, len(values))
        nodes += own
        root.append(len(nodes))
    feature, threshold, left, right = zip(*nodes) if nodes else ((), (), (), ())
    return Boosted(
        np.array(root, np.int32), np.array(first_leaf, np.int32), np.array(feature, np.uint8),
        _rounded_down(np.array(threshold, np.float64)), np.array(left, np.int8), np.array(right, np.int8),
        np.array(values, np.float32), np.array(dumped["max_feature_idx"] + 1, np.int32),
    )  # fmt: skip


def mean_of(every: Sequence[Boosted]) -> Boosted:
    """Return trees whose score is the mean of several trees' scores."""
    nodes, leaves = np.cumsum([[0, 0], *([len(t.feature), len(t.value)] for t in every)], axis=0).T
    return Boosted(
        np.concatenate([[0], *(t.root[1:] + n for t, n in zip(every, nodes))]).astype(np.int32),
        np.concatenate([t.first_leaf + n for t, n in zip(every, leaves)]).astype(np.int32),
        *(np.concatenate([getattr(t, name) for t in every]) for name in ("feature", "threshold", "left", "right")),
        np.concatenate([t.value / np.float32(len(every)) for t in every]), every[0].features,
    )  # fmt: skip


def _walk(
    node: dict[str, Any], own: list[tuple[int, float, int, int]], values: list[float], first: int
) -> int:
    """Append a node and all below it; return its row, or -1 - leaf, counted from the tree's first."""
    if "leaf_value" in node:
        values.append(node["leaf_value"])
        return first - len(values)
    row = len(own)
    own.append((0, 0.0, 0, 0))
    left, right = (_walk(node[f"{side}_child"], own, values, first) for side in ("left", "right"))
    own[row] = (node["split_feature"], node["threshold"], left, right)
    return row


def _rounded_down(threshold: np.ndarray) -> np.ndarray:
    """Return the greatest float32 up to each threshold: float32 features go the same way as before."""
    near = threshold.astype(np.float32)
    return np.where(near > threshold, np.nextafter(near, np.float32(-np.inf)), near).astype(np.float32)
