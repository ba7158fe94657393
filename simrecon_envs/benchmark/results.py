"""`Results`: the episodes of a policy on a suite, with summary statistics, as a JSON file."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from registry import UsageError
from simrecon_envs.benchmark.checked import read_list, read_record, read_text_map
from simrecon_envs.benchmark.statistics import bootstrap_mean, wilson
from simrecon_envs.files import read_json, write_json

SCHEMA = "simrecon.results/1"
STEP_S = 0.05  # duration of a control step


@dataclass(frozen=True, kw_only=True)
class EpisodeResult:
    """One episode of one task."""

    task: str  # the task's name in the suite
    revision: str
    kind: str
    scene: str
    robot: str
    scene_side: str
    object_side: str
    seed: int
    proven: bool  # the seed is one of the suite, which the oracle solved; else a fresh one
    success: bool
    steps: int
    path_m: float
    oracle_path_m: float  # for the same seed; for a fresh seed, the median over the task's seeds
    oracle_steps: float
    reward: float
    act_ms: float  # wall time of the policy per step
    video: str = ""  # file name

    @property
    def efficiency(self) -> float:
        """Return success weighted by path length: oracle path / max(path, oracle path), or 0 without success."""
        if not self.success:
            return 0.0
        return self.oracle_path_m / max(self.path_m, self.oracle_path_m, 1e-9)

    @property
    def pair(self) -> tuple:
        """Return the key that pairs the episode with the same episode of another policy."""
        return self.task, self.revision, self.seed


@dataclass(frozen=True, kw_only=True)
class Results:
    """The episodes, in the order of the suite, and what they were run with."""

    suite: dict[str, Any]  # name, digest
    policy: dict[str, Any]  # name, arguments, options (arguments of gym.make that all tasks share)
    selection: dict[str, Any]
    episodes: tuple[EpisodeResult, ...]
    notes: tuple[str, ...] = ()
    made_with: dict[str, str] = field(default_factory=dict)

    def summary(self) -> dict[str, Any]:
        """Return the statistics of all episodes, and by kind, scene, robot and split."""
        out: dict[str, Any] = {"all": figures(self.episodes)}
        for name in ("kind", "scene", "robot", "object_side", "scene_side"):
            values = sorted({getattr(e, name) for e in self.episodes})
            out[name] = {v: figures([e for e in self.episodes if getattr(e, name) == v]) for v in values}
        return out

    def save(self, path: Path) -> None:
        """Write the results atomically."""
        body = asdict(self)
        order = ("suite", "policy", "selection", "made_with", "notes")
        head = {"schema": SCHEMA, **{key: body[key] for key in order}}
        write_json(path, {**head, "summary": self.summary(), "episodes": body["episodes"]})


def load_results(path: Path | str) -> Results:
    """Read results.

    Raises:
        UsageError: the file is absent, damaged, or of another schema version.
    """
    path = Path(path)
    body = read_json(path, "results", SCHEMA)
    try:
        rows = enumerate(read_list(body["episodes"], "episodes"))
        episodes = [
            read_record(EpisodeResult, entry, f"episodes[{n}]", negative=("reward",)) for n, entry in rows
        ]
        for name in ("suite", "policy", "selection"):
            if not isinstance(body[name], dict):
                raise ValueError(f"{name}: expected an object, found {type(body[name]).__name__}")
        notes = read_text_map(dict(enumerate(read_list(body["notes"], "notes"))), "notes")
        return Results(
            suite=read_text_map(body["suite"], "suite"),
            policy=body["policy"] | {"name": str(body["policy"]["name"])},
            selection=body["selection"],
            episodes=tuple(episodes),
            notes=tuple(notes.values()),
            made_with=read_text_map(body["made_with"], "made_with"),
        )
    except (KeyError, ValueError) as error:
        said = f"the field {error} is missing" if isinstance(error, KeyError) else str(error)
        raise UsageError(f"results {path}: {said}") from error


def figures(episodes: Sequence[EpisodeResult]) -> dict[str, Any]:
    """Return {figure: {value, interval, …}} over episodes; steps and seconds are over the successful ones."""
    done = [e for e in episodes if e.success]
    rate = len(done) / len(episodes)
    return {
        "episodes": len(episodes),
        "tasks": len({e.task for e in episodes}),
        "success": {"value": rate, "interval": wilson(len(done), len(episodes)), "count": len(done)},
        "path_efficiency": _mean([e.efficiency for e in episodes], [e.task for e in episodes]),
        "steps": _mean([e.steps for e in done], [e.task for e in done]),
        "seconds": _mean([e.steps * STEP_S for e in done], [e.task for e in done]),
        "reward": _mean([e.reward for e in episodes], [e.task for e in episodes]),
        "act_ms": _mean([e.act_ms for e in episodes], [e.task for e in episodes]),
    }


def _mean(values: list[float], tasks: list[str]) -> dict[str, Any]:
    if not values:
        return {"value": None, "interval": None}
    return {"value": sum(values) / len(values), "interval": bootstrap_mean(values, tasks)}
