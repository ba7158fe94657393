"""Figures of several runs that differ in the last bits of their depth maps: mean and spread."""

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Any

from benchmarks.results import Result
from benchmarks.variants import run_of

SCHEMA = "simrecon.benchmark-spread/1"


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


@dataclass(frozen=True)
class PooledResult(Result):
    """Several runs of one variant on one capture; all but the figures is of the first run that has figures."""

    runs: tuple[Result, ...] = ()

    @cached_property
    def metrics(self) -> dict[str, float | None]:
        """The means of the runs' figures."""
        keys = dict.fromkeys(key for figures in self._figures for key in figures)
        found = {key: self.spread(key) for key in keys}
        return {key: None if value is None else value.mean for key, value in found.items()}

    @cached_property
    def _figures(self) -> list[dict[str, float | None]]:
        return [run.metrics for run in self.runs]

    def spread(self, key: str) -> Spread | None:
        """Return a figure's mean and spread; a run that failed counts as recall 0."""
        zero = key.startswith("object_recall")
        pairs = zip(self.runs, self._figures)
        return spread_of([0.0 if run.failed and zero else figures.get(key) for run, figures in pairs])


def pool(results: Sequence[Result]) -> list[Result]:
    """Join the runs of each capture and variant; what ran once is returned as it is.

    Runs of other code or another input than those of the run without noise are left out.
    """
    groups: dict[tuple[str, str], list[tuple[int, Result]]] = {}
    for result in results:
        variant, seed = run_of(result.variant)
        groups.setdefault((result.capture, variant), []).append((seed, result))
    out: list[Result] = []
    for (_, variant), group in groups.items():
        runs = [run for _, run in sorted(group, key=lambda item: item[0])]
        same = tuple(r for r in runs if (r.sources, r.inputs) == (runs[0].sources, runs[0].inputs))
        if len(same) == 1 and same[0].variant == variant:
            out.append(same[0])
            continue
        shown = next((run for run in same if not run.failed), same[0])
        values = {field.name: getattr(shown, field.name) for field in fields(Result)}
        out.append(PooledResult(**{**values, "variant": variant}, runs=same))
    return out


def save_spreads(results: Sequence[Result], out: Path) -> list[Path]:
    """Write mean, spread, least and greatest of every figure as <out>/<capture>/spread/<variant>.json."""
    written = []
    for result in pool(results):
        if not isinstance(result, PooledResult):
            continue
        found = {key: result.spread(key) for key in result.metrics}
        data = {
            "schema": SCHEMA,
            "capture": result.capture,
            "variant": result.variant,
            "runs": [run.variant for run in result.runs],
            "failed": [run.variant for run in result.runs if run.failed],
            "figures": {key: None if value is None else asdict(value) for key, value in found.items()},
        }
        path = out / result.capture / "spread" / f"{result.variant}.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(data, indent=1) + "\n")
        written.append(path)
    return written
