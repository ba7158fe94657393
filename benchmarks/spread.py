"""Figures of several runs that differ in the last bits of their depth maps: mean and spread."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any


@dataclass(frozen=True)
class Spread:
    """One figure over several runs."""

    mean: float
    sd: float  # standard deviation of single runs (n - 1); 0 of one run
    min: float
    max: float
    runs: int  # that have the figure


def spread_of(values: Sequence[float | None]) -> Spread | None:
    """Return mean and spread of the runs that have the figure; None where none has."""
    known = [float(value) for value in values if value is not None and math.isfinite(value)]
    if not known:
        return None
    mean = sum(known) / len(known)
    sd = math.sqrt(sum((v - mean) ** 2 for v in known) / (len(known) - 1)) if len(known) > 1 else 0.0
    return Spread(mean, sd, min(known), max(known), len(known))


def spread_tree(runs: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return nested figures of several runs as one tree whose numbers are spreads; what is no number is left out."""
    out: dict[str, Any] = {}
    for key in dict.fromkeys(key for run in runs for key in run):
        values = [run.get(key) for run in runs]
        if any(isinstance(value, dict) for value in values):
            out[key] = spread_tree([value for value in values if isinstance(value, dict)])
        elif all(value is None or isinstance(value, (int, float)) for value in values):
            found = spread_of(values)
            out[key] = None if found is None else asdict(found)
    return out
