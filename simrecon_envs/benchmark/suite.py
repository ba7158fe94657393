"""`Suite`: tasks with scenes, episode seeds and the oracle's solutions, as a JSON file."""

import fnmatch
import hashlib
import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import gymnasium as gym

from registry import SimReconError, UsageError
from simrecon_envs.benchmark.splits import SIDES
from simrecon_envs.files import read_json, write_json

SCHEMA = "simrecon.suite/1"
SPLITS = ("all", *SIDES)
SPLIT_BY = ("object", "scene")


@dataclass(frozen=True, kw_only=True)
class OracleRun:
    """The oracle's solution of an episode."""

    seed: int
    steps: int
    path_m: float  # path length of the hand; of the base in navigation tasks


@dataclass(frozen=True, kw_only=True)
class SuiteTask:
    """A task of a suite, with one episode per entry of `oracle`."""

    name: str  # "room-pick_mug-panda", unique in the suite
    env_id: str  # for gym.make
    scene: str
    revision: str  # of the scene's bundle
    task: str
    kind: str
    robot: str
    instruction: str
    max_steps: int
    objects: tuple[str, ...]  # "room/7": the movable objects that the task is about
    scene_side: str
    object_side: str  # "test" if any of its objects is in the test split
    oracle: tuple[OracleRun, ...]

    @property
    def seeds(self) -> tuple[int, ...]:
        """Return the seeds of the episodes."""
        return tuple(run.seed for run in self.oracle)

    def options(self) -> dict[str, Any]:
        """Return the task's arguments of `gym.make`, in addition to the suite's `options`."""
        return {"robot_uids": self.robot, "max_episode_steps": self.max_steps}


@dataclass(frozen=True, kw_only=True)
class LeftOut:
    """A candidate that is not in the suite, and why."""

    scene: str
    robot: str
    task: str
    kind: str
    reason: str


@dataclass(frozen=True, kw_only=True)
class Suite:
    """The tasks of a suite. Contains no path and no time, so the same input gives the same file."""

    tasks: tuple[SuiteTask, ...]
    left_out: tuple[LeftOut, ...] = ()
    options: dict[str, Any] = field(default_factory=dict)  # arguments of gym.make for every task
    settings: dict[str, Any] = field(default_factory=dict)  # of its generation
    made_with: dict[str, str] = field(default_factory=dict)  # versions

    @property
    def digest(self) -> str:
        """Return 16 hexadecimal digits that identify the episodes."""
        rows = [(t.env_id, t.revision, t.robot, t.max_steps, t.seeds) for t in self.tasks]
        text = json.dumps([SCHEMA, self.options, rows], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    @property
    def revisions(self) -> dict[str, str]:
        """Return {scene: revision}."""
        return {task.scene: task.revision for task in self.tasks}

    def select(
        self,
        *,
        split: str = "all",
        split_by: str = "object",
        tasks: str = "*",
        kinds: Iterable[str] = (),
        robots: Iterable[str] = (),
    ) -> list[SuiteTask]:
        """Return the tasks that pass every filter.

        Args:
            split: "all", "train" or "test".
            split_by: "object" or "scene".
            tasks: Patterns of task names with `*` and `?`, separated by commas.
            kinds: Only these kinds; all where empty.
            robots: Only these robots; all where empty.

        Raises:
            UsageError: there is no such split, or no task passes.
        """
        if split not in SPLITS or split_by not in SPLIT_BY:
            raise UsageError(
                f"split {split!r} by {split_by!r}: splits are {', '.join(SPLITS)}, by {' or '.join(SPLIT_BY)}"
            )
        patterns, kinds, robots = tasks.split(","), set(kinds), set(robots)
        side = {"object": "object_side", "scene": "scene_side"}[split_by]
        chosen = [
            t
            for t in self.tasks
            if (split == "all" or getattr(t, side) == split)
            and any(fnmatch.fnmatchcase(t.name, pattern.strip()) for pattern in patterns)
            and (not kinds or t.kind in kinds)
            and (not robots or t.robot in robots)
        ]
        if not chosen:
            raise UsageError(
                f"none of the suite's {len(self.tasks)} tasks is in the split {split!r} (by {split_by}) with the name "
                f"{tasks!r}{_among('kind', kinds)}{_among('robot', robots)}; some of its tasks: {_some(self.tasks)}"
            )
        return chosen

    def make(self, task: SuiteTask, *, registry: Path | str | None = None, **kwargs: Any) -> gym.Env:
        """Make the environment of a task, with NumPy observations.

        Raises:
            UsageError: ManiSkill rejects an argument; quotes its message.
        """
        from simrecon_envs.registration import make_cpu

        try:
            return make_cpu(task.env_id, registry=registry, **{**self.options, **task.options(), **kwargs})
        except SimReconError:
            raise
        except (AssertionError, KeyError, TypeError, ValueError) as error:
            said = str(error).partition(" was raised from the environment creator")[0]
            wanted = ", ".join(f"{key}={value!r}" for key, value in kwargs.items()) or "no options"
            raise UsageError(f"{task.name}: no environment can be made with {wanted}: {said}") from error

    def save(self, path: Path) -> None:
        """Write the suite atomically."""
        body = asdict(self)
        head = {"schema": SCHEMA, "digest": self.digest}
        order = ("made_with", "settings", "options", "tasks", "left_out")
        write_json(path, {**head, **{key: body[key] for key in order}})


def load_suite(path: Path | str) -> Suite:
    """Read a suite.

    Raises:
        UsageError: the file is absent, damaged, edited, or of another schema version.
    """
    path = Path(path)
    body = read_json(path, "suite", SCHEMA)
    try:
        tasks = tuple(_task(entry) for entry in body["tasks"])
        left_out = tuple(LeftOut(**entry) for entry in body["left_out"])
        suite = Suite(
            tasks=tasks,
            left_out=left_out,
            options=body["options"],
            settings=body["settings"],
            made_with=body["made_with"],
        )
    except (KeyError, TypeError) as error:
        raise UsageError(f"suite {path}: a field is missing, unknown or of another type: {error}") from error
    names = [task.name for task in suite.tasks]
    if not names or len(set(names)) < len(names):
        raise UsageError(f"suite {path}: it has {'no tasks' if not names else 'two tasks of one name'}")
    if suite.digest != body.get("digest"):
        raise UsageError(
            f"suite {path}: the tasks were changed after it was written (digest {body.get('digest')!r}, now "
            f"{suite.digest!r}); generate it again instead of editing it, or choose with --tasks, --kinds and --split"
        )
    return suite


def _task(entry: dict) -> SuiteTask:
    runs = tuple(OracleRun(**run) for run in entry["oracle"])
    if not runs or not isinstance(entry["max_steps"], int) or entry["max_steps"] < 1:
        raise TypeError(f"task {entry['name']}: expected seeds and at least one step")
    return SuiteTask(**{**entry, "objects": tuple(entry["objects"]), "oracle": runs})


def _among(what: str, wanted: set[str]) -> str:
    return f", of the {what} {' or '.join(sorted(wanted))}" if wanted else ""


def _some(tasks: tuple[SuiteTask, ...]) -> str:
    return ", ".join(task.name for task in tasks[:3])
