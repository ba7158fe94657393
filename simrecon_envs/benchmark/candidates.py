"""List the tasks of a scene that may enter a suite, in the order in which they are tried. Reads bundles only."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path

from registry import UsageError, open_registry
from simrecon_envs.registration import env_id
from simrecon_envs.tasks import KINDS, TaskSpec, kind_of, list_specs
from simrecon_envs.tasks.facts import SceneFacts
from simrecon_envs.tasks.spec import THEN

SEQUENCE = "sequence"
_MOST_A_KIND = 24  # candidates per kind and robot; a scene of 20 objects has hundreds of places and stacks
# Kinds of the first and second stage of a composite, preferred ones first.
_FIRST = ("put", "place", "push", "stack", "reach")
_THEN = ("pick", "push", "put", "place", "reach")


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """A task that may enter the suite."""

    scene: str
    revision: str
    robot: str
    task: str
    kind: str
    objects: tuple[int, ...]  # ids of the movable objects that it is about
    problems: tuple[str, ...]  # known from the bundle

    @property
    def name(self) -> str:
        """Return the task's name in the suite."""
        return f"{self.scene}-{self.task}-{self.robot}"

    @property
    def env_id(self) -> str:
        """Return the Gymnasium id."""
        return env_id(self.scene, self.task)


def scene_candidates(
    scene: str, robots: tuple[str, ...], kinds: tuple[str, ...], registry: Path | None
) -> list[Candidate]:
    """Return the candidates of a scene without composites: round-robin over kinds and robots, the easiest first.

    Raises:
        SceneNotFound: there is no such scene.
        UsageError: there is no such robot.
    """
    bundle = open_registry(registry).load(scene)
    queues = []
    for robot in robots:
        facts = SceneFacts(bundle, robot)
        singles = [kind for kind in kinds if kind != SEQUENCE]
        specs = [s for s in list_specs(facts, kinds=tuple(singles), hard=True) if _concerns(s, facts)]
        for kind in singles:
            mine = [_candidate(scene, bundle.revision, facts, s) for s in specs if s.kind == kind]
            hard = [c for c in mine if c.problems]
            queues.append([c for c in mine if not c.problems][:_MOST_A_KIND] + hard)
    return [c for row in zip_longest(*queues) for c in row if c is not None]


def composites(accepted: list[Candidate], most: int) -> Iterator[Candidate]:
    """Yield composites of two proven tasks of one robot about different objects.

    Args:
        accepted: The proven candidates of one scene.
        most: Greatest number per robot.
    """
    for robot in dict.fromkeys(c.robot for c in accepted):
        mine = [c for c in accepted if c.robot == robot]
        pairs = [
            (_FIRST.index(a.kind) + _THEN.index(b.kind), a, b)
            for a in mine
            for b in mine
            if a.kind in _FIRST and b.kind in _THEN and not set(a.objects) & set(b.objects)
        ]
        used: dict[str, int] = {}
        count = 0
        for _, a, b in sorted(pairs, key=lambda pair: pair[0]):
            if count == most:
                break
            if used.get(a.task, 0) > 1 or used.get(b.task, 0) > 1:
                continue  # a task is in at most two composites
            used[a.task], used[b.task] = used.get(a.task, 0) + 1, used.get(b.task, 0) + 1
            count += 1
            yield Candidate(
                scene=a.scene, revision=a.revision, robot=robot, task=f"{a.task}{THEN}{b.task}", kind=SEQUENCE,
                objects=tuple(dict.fromkeys((*a.objects, *b.objects))), problems=(),
            )  # fmt: skip


def check_kinds(kinds: tuple[str, ...]) -> tuple[str, ...]:
    """Return the kinds in listing order; all where none is named.

    Raises:
        UsageError: there is no such kind.
    """
    known = (*KINDS, SEQUENCE)
    wrong = [kind for kind in kinds if kind not in known]
    if wrong:
        raise UsageError(f"{wrong[0]!r} is not a kind of task. Kinds: {', '.join(known)}")
    return tuple(kind for kind in known if not kinds or kind in kinds)


def _concerns(spec: TaskSpec, facts: SceneFacts) -> bool:
    """Return whether the robot is of the right sort for a task: a fixed arm does not drive."""
    return facts.traits.mobile or not kind_of(spec).mobile_only


def _candidate(scene: str, revision: str, facts: SceneFacts, spec: TaskSpec) -> Candidate:
    keys = KINDS[spec.kind].things(facts) if spec.subject is None else [spec.subject, spec.place]
    objects = tuple(key for key in keys if key in facts.movable)
    if not objects and spec.subject is not None and spec.subject not in facts.base_ids:
        objects = (spec.subject,)  # navigate_table is about the table
    return Candidate(
        scene=scene, revision=revision, robot=facts.robot, task=spec.name, kind=spec.kind, objects=objects,
        problems=spec.problems,
    )  # fmt: skip
