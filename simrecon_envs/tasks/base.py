"""What a kind of task is. A kind is one class in one module; `simrecon_envs.tasks.KINDS` lists them."""

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import torch

from simrecon_envs.arrays import Array, tanh
from simrecon_envs.placement import Placement
from simrecon_envs.tasks.facts import SceneFacts
from simrecon_envs.tasks.spec import TaskSpec

if TYPE_CHECKING:
    from simrecon_envs.oracle import Hand
    from simrecon_envs.scene_env import SceneEnv

Info = dict[str, Array]


class Task:
    """A task in an environment: when it is done, the reward on the way, and how a script does it.

    Every array has the number of parallel environments first, b; they are NumPy's or torch's (`arrays`). Distances are
    in metres, world space.
    """

    kind: ClassVar[str]
    subjects: ClassVar[bool] = True  # names an object; "rearrange" is about the scene
    joint: ClassVar[str] = ""  # between subject and place in the task's name
    max_reward: ClassVar[float]
    mobile_only: ClassVar[bool] = False
    lasting: ClassVar[bool] = True  # a stage of a composite must still be done at its end

    @classmethod
    def options(cls, facts: SceneFacts) -> list[tuple[int | None, int | None]]:
        """Return the (subject, place) that the scene's graph suggests, the easiest first."""
        return [(target.id, None) for target in facts.ranked]

    @classmethod
    def problems(cls, facts: SceneFacts, subject: int | None, place: int | None) -> list[str]:
        """Return why a task can hardly be done, from what the bundle says."""
        return subject_problems(facts, subject)

    @classmethod
    def interests(cls, facts: SceneFacts, spec: TaskSpec) -> list[np.ndarray]:
        """Return places (k, 3): of each array the robot must reach at least one, besides the subject."""
        return []

    def __init__(self, env: "SceneEnv", spec: TaskSpec, placement: Placement) -> None:
        """Plan for a robot at a place; nothing is built yet, so only the scene's facts may be read."""
        self.env, self.spec, self.placement = env, spec, placement
        self.facts: SceneFacts = env.facts
        self._concerned = tuple(key for key in (spec.subject, spec.place) if key in self.facts.targets)

    @property
    def subject(self) -> int:
        """Return the id of what the task is about."""
        assert self.spec.subject is not None
        return self.spec.subject

    @classmethod
    def words(cls, facts: SceneFacts, spec: TaskSpec) -> str:
        """Return the instruction."""
        raise NotImplementedError

    @property
    def instruction(self) -> str:
        """Return the task in words, as it is in this environment."""
        return self.words(self.facts, self.spec)

    def start(self, env_idx: torch.Tensor, rng: Any) -> None:
        """Prepare an episode in the environments `env_idx`; things stand where the bundle has them."""

    def evaluate(self) -> Info:
        """Return "success" (b,) and what it depends on."""
        raise NotImplementedError

    def reward(self, info: Info) -> Array:
        """Return the dense reward (b,) between 0 and `max_reward`, which success gives."""
        raise NotImplementedError

    def observe(self, info: Info) -> dict[str, Array]:
        """Return what an agent may know of the task, each (b, k)."""
        return {}

    def script(self, hand: "Hand") -> Iterator[np.ndarray]:
        """Yield actions that do the task, one a control step."""
        raise NotImplementedError

    def _while_still(self, name: str, compute: Callable[[], Any]) -> Any:
        """Return what `compute` makes of where subject and place are, computed once until one of them moves.

        What else it depends on must be settled in `start`.
        """
        return self.env.measures.while_still((id(self), name), self._concerned, compute)

    def _undisturbed(self, compute: Callable[[], Info]) -> Info:
        """Return what `compute` makes of subject and place, once while they sleep and the hand is not at the subject.

        The exception is `tcp_to_target_m`, which is that of now.
        """
        measures = self.env.measures
        info = measures.undisturbed((id(self), "undisturbed"), self.subject, self._concerned, compute)
        return {**info, "tcp_to_target_m": measures.tcp_distance(self.subject)}

    def _zeros(self, width: int) -> Array:
        return self.env.measures.array(np.zeros((self.env.num_envs, width)))


def subject_problems(facts: SceneFacts, subject: int | None) -> list[str]:
    """Return why the robot can hardly lift an object."""
    if subject in facts.targets:
        target = facts.targets[subject]
        return [target.problem] if target.problem else []
    return [
        f"{facts.thing(subject)} cannot move" if subject in facts.labels else f"there is no object {subject}"
    ]


def draw(rng: Any, env_idx: torch.Tensor, width: int) -> np.ndarray:
    """Return uniform draws (len(env_idx), width) of ManiSkill's batched generator, by seed."""
    index = env_idx.cpu().numpy()
    return np.asarray(rng[index].uniform(size=width), np.float64).reshape(len(index), width)


def nearness(distance: Array) -> Array:
    """Return 1 at distance 0 (m), falling to 0; half at 11 cm, as in ManiSkill's tasks."""
    return 1 - tanh(5.0 * distance)
