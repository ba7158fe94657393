"""List scenes (from the registry's index) and tasks (from a bundle). Only `list_tasks` has heavy imports."""

import fnmatch
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from registry import SceneRecord, UsageError, open_registry
from simrecon_envs.registration import NAMESPACE, env_id

if TYPE_CHECKING:
    from simrecon_envs.tasks.facts import SceneFacts


@dataclass(frozen=True)
class TaskEntry:
    """A task of a scene; create it with `gym.make(entry.id)`."""

    id: str
    scene: str
    task: str
    kind: str
    instruction: str
    problems: tuple[str, ...]  # reasons why it can hardly be solved; empty if there is none


def list_scenes(
    pattern: str = "*",
    *,
    registry: Path | str | None = None,
    status: str | None = None,
    min_objects: int = 0,
    max_objects: int | None = None,
    min_movable: int = 0,
    labels: Iterable[str] = (),
    where: Callable[[SceneRecord], bool] | None = None,
) -> list[SceneRecord]:
    """Return the scenes that pass every filter, ordered by id. Bundles are opened only for `labels`.

    Args:
        pattern: Pattern of the scene id, with `*` and `?`.
        registry: Folder of the registry; None for the default one.
        status: "stable", "unstable" or "unchecked".
        min_objects: Minimum number of objects.
        max_objects: Maximum number of objects.
        min_movable: Minimum number of movable objects.
        labels: Labels that must all occur.
        where: Additional filter.

    Raises:
        UsageError: The status is unknown.
    """
    if status not in (None, "stable", "unstable", "unchecked"):
        raise UsageError(f"list_scenes: status {status!r} is not one of stable, unstable, unchecked")
    catalog = open_registry(registry)
    wanted = {label.lower() for label in ([labels] if isinstance(labels, str) else labels)}
    most = float("inf") if max_objects is None else max_objects

    def passes(record: SceneRecord) -> bool:
        cheap = (
            fnmatch.fnmatchcase(record.scene_id, pattern)
            and (status is None or record.status == status)
            and min_objects <= record.n_objects <= most
            and record.metrics.get("n_dynamic", 0) >= min_movable
            and (where is None or where(record))
        )
        if not cheap or not wanted:
            return cheap
        return wanted <= {item.label.lower() for item in catalog.load(record.scene_id).objects}

    return [record for record in catalog.list() if passes(record)]


def list_tasks(
    scene: str,
    *,
    robot: str = "panda",
    kinds: Iterable[str] | None = None,
    hard: bool = False,
    registry: Path | str | None = None,
) -> list[TaskEntry]:
    """Return the tasks of a scene for a robot, by kind, the easiest first.

    Args:
        scene: `scene0001` or `SimRecon/scene0001`.
        robot: A robot of ManiSkill; tasks depend on its gripper and reach.
        kinds: Kinds of tasks; None for all.
        hard: Include tasks with `problems`.
        registry: Folder of the registry; None for the default one.

    Raises:
        SceneNotFound: The scene does not exist.
        UsageError: The kind or the robot is unknown.
        EnvironmentMissing: The robot's files are not installed.
    """
    from simrecon_envs.robots import check_robot
    from simrecon_envs.tasks import KINDS
    from simrecon_envs.tasks.facts import scene_facts

    chosen = None if kinds is None else tuple([kinds] if isinstance(kinds, str) else kinds)
    wrong = [kind for kind in chosen or () if kind not in KINDS]
    if wrong:
        raise UsageError(f"list_tasks: {wrong[0]!r} is not a kind of task. Kinds: {', '.join(KINDS)}")
    check_robot(robot)
    name = scene.removeprefix(NAMESPACE + "/")
    facts = scene_facts(open_registry(registry).load(name), robot)
    entries = [entry for kind in KINDS if chosen is None or kind in chosen for entry in _entries(facts, kind)]
    return [entry for entry in entries if hard or not entry.problems]


def _entries(facts: "SceneFacts", kind: str) -> list[TaskEntry]:
    """Return every task of a kind with its problems; cached in `facts.listed`."""
    from simrecon_envs.planning import place_task, without_grip
    from simrecon_envs.tasks import KINDS, list_specs

    if kind not in facts.listed:
        entries = []
        for spec in list_specs(facts, kinds=(kind,), hard=True):
            problems = spec.problems or without_grip(facts, kind)
            if not problems and (note := place_task(facts, spec).note):
                problems = (note,)
            words, name = KINDS[kind].words(facts, spec), facts.scene_id
            entries.append(TaskEntry(env_id(name, spec.name), name, spec.name, kind, words, problems))
        facts.listed[kind] = entries
    return facts.listed[kind]
