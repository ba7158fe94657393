"""`Suite`: tasks with scenes, episode seeds and the oracle's solutions, as a JSON file."""

import fnmatch
import hashlib
import json
import re
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

import gymnasium as gym

from registry import SimReconError, UsageError
from simrecon_envs.benchmark.checked import read_list, read_record, read_text_map
from simrecon_envs.benchmark.splits import SIDES
from simrecon_envs.files import read_json, write_json

SCHEMA = "simrecon.suite/2"  # of the digest, too: since /2 it covers every field
SPLITS = ("all", *SIDES)
SPLIT_BY = ("object", "scene")
# Arguments of gym.make that a suite may set for all of its tasks.
_OPTIONS = ("randomize", "pose_noise", "obs_mode", "control_mode", "reward_mode", "observe_objects", "cameras",
            "sensor_configs")  # fmt: skip
_MOST_STEPS = 1_000_000
# Names become names of files, and ids are imported by Gymnasium where they have a colon.
_FORMS = {
    "name": re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,199}"),
    "env_id": re.compile(r"SimRecon/[A-Za-z0-9][A-Za-z0-9_.-]{0,199}"),
    "scene": re.compile(r"[a-z0-9_]{1,200}"),
    "revision": re.compile(r"[0-9a-f]{16}"),
    "task": re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,199}"),
    "kind": re.compile(r"[a-z0-9_]{1,100}"),
    "robot": re.compile(r"[A-Za-z0-9][A-Za-z0-9_]{0,99}"),
}


@dataclass(frozen=True, kw_only=True)
class OracleRun:
    """The oracle's solution of an episode."""

    seed: int
    steps: int
    path_m: float  # path length of the hand; of the base in navigation tasks


@dataclass(frozen=True, kw_only=True)
class SuiteTask:
    """A task of a suite, with one episode per entry of `oracle`.

    Raises:
        ValueError: a name could not be that of a file or an environment of this project, or a number is out of range.
    """

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

    def __post_init__(self) -> None:
        """Check the forms of all names, and the ranges of numbers."""
        for field_name, form in _FORMS.items():
            value = getattr(self, field_name)
            if not form.fullmatch(value) or ".." in value:
                raise ValueError(f"{field_name}: {value[:80]!r} is not of the form {form.pattern}")
        for field_name in ("scene_side", "object_side"):
            if getattr(self, field_name) not in SIDES:
                raise ValueError(
                    f"{field_name}: expected {' or '.join(SIDES)}, found {getattr(self, field_name)!r}"
                )
        if not 1 <= self.max_steps <= _MOST_STEPS:
            raise ValueError(f"max_steps: expected 1 to {_MOST_STEPS}, found {self.max_steps}")
        if not self.oracle:
            raise ValueError("oracle: expected at least one episode")
        for number, run in enumerate(self.oracle):
            if run.seed >= 2**32 or not 1 <= run.steps <= self.max_steps or not run.path_m > 0:
                raise ValueError(
                    f"oracle[{number}]: expected a seed below 2**32, 1 to max_steps steps and a path longer than 0, "
                    f"found seed {run.seed}, {run.steps} steps, {run.path_m} m"
                )

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
        """Return 16 hexadecimal digits of the SHA-256 over all fields."""
        text = json.dumps([SCHEMA, asdict(self)], sort_keys=True, allow_nan=False)
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
        suite = _read(body)
    except (KeyError, ValueError) as error:
        said = f"the field {error} is missing" if isinstance(error, KeyError) else str(error)
        raise UsageError(f"suite {path}: {said}") from error
    names = [task.name for task in suite.tasks]
    if not names or len(set(names)) < len(names):
        raise UsageError(f"suite {path}: it has {'no tasks' if not names else 'two tasks of one name'}")
    if suite.digest != body.get("digest"):
        raise UsageError(
            f"suite {path}: the tasks were changed after it was written (digest {body.get('digest')!r}, now "
            f"{suite.digest!r}); generate it again instead of editing it, or choose with --tasks, --kinds and --split"
        )
    return suite


def _read(body: dict[str, Any]) -> Suite:
    """Return the suite of a JSON object. Raises KeyError or ValueError, which name the field."""
    unknown = sorted(set(body) - {"schema", "digest", *(item.name for item in fields(Suite))})
    if unknown:
        raise ValueError(f"unknown field {unknown[0][:80]!r}")
    for name in ("options", "settings"):
        if not isinstance(body[name], dict):
            raise ValueError(f"{name}: expected an object, found {type(body[name]).__name__}")
    wrong = sorted(set(body["options"]) - set(_OPTIONS))
    if wrong:
        raise ValueError(f"options: {wrong[0][:80]!r} is none of {', '.join(_OPTIONS)}")
    seed = body["settings"].get("seed", 0)
    if isinstance(seed, bool) or not isinstance(seed, int) or not 0 <= seed < 2**32:
        raise ValueError(
            f"settings.seed: expected a whole number from 0 to 2**32 - 1, found {str(seed)[:80]!r}"
        )
    tasks = []
    for number, entry in enumerate(read_list(body["tasks"], "tasks")):
        try:
            tasks.append(read_record(SuiteTask, entry, f"tasks[{number}]"))
        except ValueError as error:
            said = str(error)
            raise ValueError(said if said.startswith("tasks[") else f"tasks[{number}].{said}") from error
    left_out = read_list(body["left_out"], "left_out")
    return Suite(
        tasks=tuple(tasks),
        left_out=tuple(read_record(LeftOut, entry, f"left_out[{n}]") for n, entry in enumerate(left_out)),
        options=body["options"],
        settings=body["settings"],
        made_with=read_text_map(body["made_with"], "made_with"),
    )


def _among(what: str, wanted: set[str]) -> str:
    return f", of the {what} {' or '.join(sorted(wanted))}" if wanted else ""


def _some(tasks: tuple[SuiteTask, ...]) -> str:
    return ", ".join(task.name for task in tasks[:3])
