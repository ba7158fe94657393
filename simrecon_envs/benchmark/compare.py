"""Compare two policies on the episodes that both have run, paired by task, revision and seed."""

from dataclasses import dataclass
from typing import Any

from registry import UsageError
from simrecon_envs.benchmark.results import EpisodeResult, Results
from simrecon_envs.benchmark.statistics import Interval, bootstrap_mean, mcnemar

_KEYS = ("kind", "scene", "robot")


@dataclass(frozen=True, kw_only=True)
class Difference:
    """Second minus first, over the common episodes."""

    episodes: int
    success_first: float
    success_second: float
    success: float
    success_interval: Interval | None  # bootstrap over tasks
    only_first: int  # episodes that only the first policy solved
    only_second: int
    p: float  # of McNemar's exact test over episodes
    efficiency: float
    efficiency_interval: Interval | None
    steps: float | None  # over the episodes that both solved
    steps_interval: Interval | None


def compare_results(first: Results, second: Results) -> dict[str, Any]:
    """Return {"all": Difference, "kind": {…}, "scene": {…}, "robot": {…}, "notes": [...]}.

    Raises:
        UsageError: the results have no episode in common.
    """
    mine = {episode.pair: episode for episode in first.episodes}
    pairs = [(mine[e.pair], e) for e in second.episodes if e.pair in mine]
    if not pairs:
        raise UsageError(
            f"the results have no episode in common: the first is of the suite {first.suite}, the second of "
            f"{second.suite}; run both policies on one suite with the same --episodes, --tasks and --fresh-seeds"
        )
    out: dict[str, Any] = {"all": _difference(pairs), "notes": _notes(first, second, len(pairs))}
    for key in _KEYS:
        values = sorted({getattr(a, key) for a, _ in pairs})
        out[key] = {v: _difference([p for p in pairs if getattr(p[0], key) == v]) for v in values}
    return out


def _difference(pairs: list[tuple[EpisodeResult, EpisodeResult]]) -> Difference:
    tasks = [a.task for a, _ in pairs]
    success = [float(b.success) - float(a.success) for a, b in pairs]
    efficiency = [b.efficiency - a.efficiency for a, b in pairs]
    both = [(a, b) for a, b in pairs if a.success and b.success]
    steps = [float(b.steps - a.steps) for a, b in both]
    lost = sum(a.success and not b.success for a, b in pairs)
    won = sum(b.success and not a.success for a, b in pairs)
    return Difference(
        episodes=len(pairs),
        success_first=sum(a.success for a, _ in pairs) / len(pairs),
        success_second=sum(b.success for _, b in pairs) / len(pairs),
        success=sum(success) / len(pairs),
        success_interval=bootstrap_mean(success, tasks),
        only_first=lost,
        only_second=won,
        p=mcnemar(lost, won),
        efficiency=sum(efficiency) / len(pairs),
        efficiency_interval=bootstrap_mean(efficiency, tasks),
        steps=sum(steps) / len(steps) if steps else None,
        steps_interval=bootstrap_mean(steps, [a.task for a, _ in both]) if steps else None,
    )


def _notes(first: Results, second: Results, count: int) -> list[str]:
    notes = []
    if first.suite["digest"] != second.suite["digest"]:
        notes.append("the results are of different suites; only common episodes are compared")
    alone = [len(r.episodes) - count for r in (first, second)]
    if any(alone):
        notes.append(
            f"not compared: {alone[0]} episodes that only the first ran, {alone[1]} that only the second ran"
        )
    keys = sorted(first.made_with.keys() | second.made_with.keys())
    differs = [key for key in keys if first.made_with.get(key) != second.made_with.get(key)]
    if differs:
        texts = [f"{key} {first.made_with.get(key)} and {second.made_with.get(key)}" for key in differs]
        notes.append(f"different versions: {', '.join(texts)}")
    return notes
