"""Choose the task and the robot's place: SceneFacts + names -> Plan. Runs before the simulator is built."""

from dataclasses import dataclass

from registry import UsageError
from simrecon_envs.placement import Placement, choose_targets
from simrecon_envs.robots import robot_shape
from simrecon_envs.tasks import KINDS, kind_of, list_specs, parse_task, unknown_task
from simrecon_envs.tasks.facts import SceneFacts
from simrecon_envs.tasks.spec import TaskSpec

_TRIES = 8  # feasible tasks of a kind that are placed before one out of reach is accepted
_HARD_TRIES = 2  # the same for tasks with problems


@dataclass(frozen=True)
class Plan:
    """Task and place of the robot."""

    spec: TaskSpec | None
    placement: Placement | None  # None without a robot
    note: str  # why the task is hard or not the requested one


def plan_task(facts: SceneFacts, task: str, target: str | int) -> Plan:
    """Choose the task and the robot's place.

    Args:
        facts: The scene and the robot; its name is "none" without a robot.
        task: A kind (the easiest task of it is chosen), the name of a task, or "none".
        target: "auto", or the id or label of the object that a kind of task is about.

    Raises:
        UsageError: The task or target is unknown; lists the known ones.
    """
    if facts.robot == "none":
        return Plan(None, None, "there is no robot" if task != "none" else "")
    if task == "none":
        return Plan(None, _stand(facts, facts.ranked[:1], []), "")
    if missing := without_grip(facts, task.split("_")[0]):
        parse_task(facts, task) if task not in KINDS else None
        return Plan(None, _stand(facts, facts.ranked[:1], []), missing[0])
    if task not in KINDS:
        return place_task(facts, parse_task(facts, task))
    if task == "pick" and target == "auto" and not facts.ranked:
        return Plan(None, _stand(facts, [], []), "nothing in this scene can move")
    specs = _of_kind(facts, task, target)
    if not specs:
        raise UsageError(unknown_task(facts, task))
    plans: list[Plan] = []
    feasible, hard = ([s for s in specs if s.feasible is wanted] for wanted in (True, False))
    for spec in feasible[:_TRIES] + hard[:_HARD_TRIES]:
        plans.append(place_task(facts, spec))
        if not plans[-1].note:
            return plans[-1]
    return min(plans, key=_problems)


def _problems(plan: Plan) -> int:
    assert plan.spec is not None
    assert plan.placement is not None
    return len(plan.spec.problems) + bool(plan.placement.note)


def without_grip(facts: SceneFacts, kind: str) -> tuple[str, ...]:
    """Return why a robot cannot do a kind of task: it cannot detect grasps. Empty if it can."""
    if kind == "navigate" or robot_shape(facts.robot).has_gripper:
        return ()
    return (f"robot {facts.robot!r} cannot tell whether it grasps something",)


def _of_kind(facts: SceneFacts, kind: str, target: str | int) -> list[TaskSpec]:
    specs = list_specs(facts, kinds=(kind,), hard=True)
    if target == "auto" or not KINDS[kind].subjects:
        return specs
    if kind == "navigate":
        wanted = {
            facts.names.get(str(target)),
            *(o.id for o in facts.bundle.objects if str(o.id) == str(target)),
        }
        return [spec for spec in specs if spec.subject in wanted]
    ids: list[int | None] = [found.id for found in choose_targets(facts.ranked, target, facts.bundle)]
    return sorted((s for s in specs if s.subject in ids), key=lambda s: ids.index(s.subject))


def place_task(facts: SceneFacts, spec: TaskSpec) -> Plan:
    """Find the robot's place for a task.

    Raises:
        UsageError: The robot cannot do the task, or its object is no target.
    """
    if any(stage.kind == "navigate" for stage in spec.stages):
        raise UsageError(f"task {spec.name!r}: navigate cannot be a stage; make an environment of it alone")
    kind = kind_of(spec)
    if kind.mobile_only:
        if not facts.traits.mobile:
            raise UsageError(
                f"task {spec.name!r}: robot {facts.robot!r} does not drive; use robot_uids='fetch'"
            )
        placement = kind.plan(facts, spec)
    else:
        subject = spec.subject if not spec.stages else spec.stages[0].subject
        interests = kind.interests(facts, spec)
        if subject is None:  # several objects: plan for the first
            targets = [facts.targets[key] for key in kind.things(facts)[:1]]
        else:
            targets = [facts.targets[subject]] if subject in facts.targets else []
        if not targets:
            raise UsageError(f"scene {facts.scene_id}: task {spec.name!r}: {'; '.join(spec.problems)}")
        placement = _stand(facts, targets, interests)
    problems = [*spec.problems, *([placement.note] if placement.note else [])]
    return Plan(spec, placement, "; ".join(dict.fromkeys(problems)))


def _stand(facts: SceneFacts, targets: list, interests: list) -> Placement:
    return facts.places.find(targets, [goals for goals in interests if len(goals)])
