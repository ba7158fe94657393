"""Success rates, means, their 95 % intervals, and McNemar's test. Deterministic."""

import math
from collections.abc import Hashable, Sequence

import numpy as np

Interval = tuple[float, float]
_DRAWS = 4000  # bootstrap resamples


def wilson(successes: int, count: int) -> Interval:
    """Return the 95 % Wilson score interval of a success rate."""
    if count < 1 or not 0 <= successes <= count:
        raise ValueError(
            f"expected 0 <= successes <= count and a count of at least 1, got {successes} of {count}"
        )
    from scipy.stats import binomtest

    low, high = binomtest(successes, count).proportion_ci(method="wilson")
    return float(low), float(high)


def bootstrap_mean(values: Sequence[float], groups: Sequence[Hashable]) -> Interval | None:
    """Return the 95 % cluster bootstrap interval of a mean; None with fewer than two groups.

    Whole groups (tasks) are resampled: episodes of a task are correlated, so resampling single episodes would make the
    interval too narrow.
    """
    names = list(dict.fromkeys(groups))
    if len(names) < 2:
        return None
    place = {name: k for k, name in enumerate(names)}
    index = np.array([place[group] for group in groups])
    sums = np.bincount(index, weights=np.asarray(values, np.float64), minlength=len(names))
    counts = np.bincount(index, minlength=len(names))
    drawn = np.random.default_rng(0).integers(len(names), size=(_DRAWS, len(names)))
    means = sums[drawn].sum(1) / counts[drawn].sum(1)
    low, high = np.quantile(means, [0.025, 0.975])
    return float(low), float(high)


def mcnemar(only_first: int, only_second: int) -> float:
    """Return the p-value of McNemar's exact two-sided test from the numbers of discordant pairs."""
    count = only_first + only_second
    if count == 0:
        return 1.0
    tail = sum(math.comb(count, k) for k in range(min(only_first, only_second) + 1)) / 2**count
    return min(1.0, 2 * tail)
