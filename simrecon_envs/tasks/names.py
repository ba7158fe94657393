"""Convert between task names and `TaskSpec`: `pick_mug`, `place_box_7_on_table`, `reach_can-then-pick_can`."""

from registry import UsageError
from registry.errors import did_you_mean
from simrecon_envs.tasks.facts import SceneFacts, best_name
from simrecon_envs.tasks.kinds import KINDS
from simrecon_envs.tasks.spec import THEN, TaskSpec


def list_specs(
    facts: SceneFacts, *, kinds: tuple[str, ...] | None = None, hard: bool = False
) -> list[TaskSpec]:
    """Return the tasks of a scene by kind, the easiest first.

    Args:
        facts: The scene, for a robot.
        kinds: Only these kinds; all where None.
        hard: Include tasks with known problems.
    """
    found = []
    for name, kind in KINDS.items():
        if kinds is None or name in kinds:
            specs = [_spec(facts, name, subject, place) for subject, place in kind.options(facts)]
            found += [spec for spec in specs if hard or spec.feasible]
    return found


def parse_task(facts: SceneFacts, name: str) -> TaskSpec:
    """Return the task of a name; its `problems` tell whether it is likely infeasible.

    Raises:
        UsageError: there is no such task; the message lists the tasks and the closest match.
    """
    if THEN in name:
        stages = tuple(parse_task(facts, part) for part in name.split(THEN))
        problems = tuple(f"{stage.name}: {text}" for stage in stages for text in stage.problems)
        return TaskSpec("sequence", THEN.join(s.name for s in stages), problems=problems, stages=stages)
    for key, kind in KINDS.items():
        if name == key and not kind.subjects:
            return _spec(facts, key, None, None)
        if name.startswith(f"{key}_"):
            ids = _objects(facts, name[len(key) + 1 :], kind.joint)
            if ids is not None:
                return _spec(facts, key, *ids)
    raise UsageError(unknown_task(facts, name))


def unknown_task(facts: SceneFacts, name: str) -> str:
    """Return the error message for a task that a scene does not have."""
    known = [spec.name for spec in list_specs(facts)]
    every = [spec.name for spec in list_specs(facts, hard=True)]
    meant = ""
    if name not in KINDS:  # an existing kind without tasks in this scene needs no suggestion
        of_kind = "" if "_" in name else did_you_mean(name, KINDS)
        meant = of_kind or did_you_mean(name, every, cutoff=0.4)
    shown = ", ".join(known[:12]) + (f" and {len(known) - 12} more" if len(known) > 12 else "")
    return (
        f"scene {facts.scene_id} has no task {name!r}.{meant} Kinds: {', '.join(KINDS)}, none. Tasks for "
        f"{facts.robot}: {shown or 'none, because nothing here can be moved'}"
    )


def _objects(facts: SceneFacts, text: str, joint: str) -> tuple[int, int | None] | None:
    """Return (subject, place) of a text such as `mug_on_table`; None where the scene lacks a name in it."""
    if not joint:
        return (facts.names[text], None) if text in facts.names else None
    parts = text.split(joint)
    for cut in range(1, len(parts)):
        first, second = joint.join(parts[:cut]), joint.join(parts[cut:])
        if first in facts.names and second in facts.names:
            return facts.names[first], facts.names[second]
    return None


def _spec(facts: SceneFacts, kind_name: str, subject: int | None, place: int | None) -> TaskSpec:
    kind = KINDS[kind_name]
    parts = [kind_name]
    if subject is not None:
        parts.append(best_name(facts, subject))
    name = "_".join(parts) + (kind.joint + best_name(facts, place) if place is not None else "")
    return TaskSpec(kind_name, name, subject, place, tuple(kind.problems(facts, subject, place)))
