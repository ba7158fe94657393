"""What there is: scenes by what the index knows of them, tasks by what a bundle holds. Light until tasks are listed."""

import fnmatch
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from registry import SceneRecord, SceneRegistry, UsageError
from simrecon_envs.registration import NAMESPACE, env_id


@dataclass(frozen=True)
class TaskEntry:
    """A task that can be made: `gym.make(entry.id)`."""

    id: str
    scene: str
    task: str
    kind: str
    instruction: str
    problems: tuple[str, ...]  # empty where nothing speaks against it


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
    """Return the scenes that pass every filter, ordered by id. Opens bundles only for `labels`.

    Args:
        pattern: The scene's id, with `*` and `?`.
        registry: The registry's folder; the default registry where left out.
        status: "stable", "unstable" or "unchecked".
        min_objects: Least number of objects.
        max_objects: Greatest number of objects.
        min_movable: Least number of objects that can move.
        labels: The scene has an object of each of these labels.
        where: Any other filter of a `SceneRecord`.

    Raises:
        UsageError: there is no such status.
    """
    if status not in (None, "stable", "unstable", "unchecked"):
        raise UsageError(f"list_scenes: status {status!r} is not one of stable, unstable, unchecked")
    catalog = SceneRegistry(None if registry is None else Path(registry))
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
        robot: A robot of ManiSkill; what it can grip decides.
        kinds: Only these; all where None.
        hard: With the tasks that something speaks against (their `problems` say what).
        registry: The registry's folder; the default registry where left out.

    Raises:
        SceneNotFound: there is no such scene.
        UsageError: there is no such kind.
    """
    from simrecon_envs.tasks import KINDS, list_specs
    from simrecon_envs.tasks.facts import SceneFacts

    chosen = None if kinds is None else tuple([kinds] if isinstance(kinds, str) else kinds)
    wrong = [kind for kind in chosen or () if kind not in KINDS]
    if wrong:
        raise UsageError(f"list_tasks: {wrong[0]!r} is not a kind of task. Kinds: {', '.join(KINDS)}")
    name = scene.removeprefix(NAMESPACE + "/")
    bundle = SceneRegistry(None if registry is None else Path(registry)).load(name)
    facts = SceneFacts(bundle, robot)
    specs = list_specs(facts, kinds=chosen, hard=hard)
    return [
        TaskEntry(env_id(name, s.name), name, s.name, s.kind, KINDS[s.kind].words(facts, s), s.problems)
        for s in specs
    ]
