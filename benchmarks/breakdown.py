"""Break object recall down by size, support, distance to the nearest neighbor, and visibility.

Input: the records that `simrecon evaluate --json` writes under `objects` and `stages.instances.boxes.objects`, of one
capture or pooled over many.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from reconstruction.measure.object_facts import SUPPORTS

SIZE_EDGES_CM = (5.0, 10.0, 20.0, 50.0)  # of the longest side; a bin includes its lower edge
GAP_EDGES_CM = (2.0, 5.0, 10.0, 30.0)  # to the nearest neighbor
SEEN_EDGES = (10_000.0, 30_000.0, 100_000.0)  # visible pixels, summed over all frames
_ON = {"floor": "on the floor", "furniture": "on furniture", "thing": "on a thing", "wall": "on a wall"}


@dataclass(frozen=True)
class Share:
    """A proportion: `found` of `count`."""

    found: int
    count: int

    @property
    def value(self) -> float:
        """The proportion; NaN if `count` is 0."""
        return self.found / self.count if self.count else float("nan")

    @property
    def interval(self) -> tuple[float, float]:
        """The 95 % Wilson score interval."""
        return wilson(self.found, self.count)


@dataclass(frozen=True)
class Bin:
    """Recall of the objects in one bin."""

    name: str
    recall_25: Share
    recall_50: Share


def wilson(found: int, count: int) -> tuple[float, float]:
    """Return the 95 % Wilson score interval of a proportion; (0, 1) if `count` is 0."""
    from scipy.stats import binomtest

    if not count:
        return 0.0, 1.0
    low, high = binomtest(found, count).proportion_ci(method="wilson")
    return float(low), float(high)


def breakdown(records: Sequence[dict[str, Any]]) -> dict[str, list[Bin]]:
    """Bin records by "size", "support", "gap" and "seen"; return the non-empty bins, the last one is "all".

    Args:
        records: evaluated true objects with `longest_side_cm`, `support`, `gap_cm`, `visible_pixels`, `found_25` and
            `found_50`.
    """
    sizes = [_bin_name(r["longest_side_cm"], SIZE_EDGES_CM) for r in records]
    gaps = [_bin_name(np.inf if r["gap_cm"] is None else r["gap_cm"], GAP_EDGES_CM) for r in records]
    seen = [_bin_name(r["visible_pixels"], SEEN_EDGES, "pixels") for r in records]
    return {
        "size": _bins(records, sizes, bin_names(SIZE_EDGES_CM)),
        "support": _bins(records, [_ON[r["support"]] for r in records], [_ON[s] for s in SUPPORTS]),
        "gap": _bins(records, gaps, bin_names(GAP_EDGES_CM)),
        "seen": _bins(records, seen, bin_names(SEEN_EDGES, "pixels")),
    }


def bin_names(edges: Sequence[float], unit: str = "cm") -> list[str]:
    """Name the bins: below the first edge, between two edges, from the last edge."""
    inner = [f"{low:,g}–{high:,g} {unit}" for low, high in pairwise(edges)]
    return [f"< {edges[0]:,g} {unit}", *inner, f"≥ {edges[-1]:,g} {unit}"]


def _bin_name(value: float, edges: Sequence[float], unit: str = "cm") -> str:
    return bin_names(edges, unit)[int(np.searchsorted(edges, value, side="right"))]


def _bins(records: Sequence[dict[str, Any]], names: Sequence[str], order: Iterable[str]) -> list[Bin]:
    groups = [(name, [r for r, n in zip(records, names) if n == name]) for name in order]
    groups = [group for group in groups if group[1]] + [("all", list(records))]
    return [Bin(name, _share(group, "found_25"), _share(group, "found_50")) for name, group in groups]


def _share(records: Sequence[dict[str, Any]], key: str) -> Share:
    return Share(sum(bool(r[key]) for r in records), len(records))
