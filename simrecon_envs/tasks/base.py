"""`Task`, the base class of all kinds of tasks, and what several kinds share. docs/extending.md adds a kind."""

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import torch

from simrecon_envs.arrays import Array, tanh
from simrecon_envs.oracle import Hand
from simrecon_envs.placement import Placement
from simrecon_envs.tasks.facts import SceneFacts
from simrecon_envs.tasks.spec import TaskSpec

if TYPE_CHECKING:
    from simrecon_envs.scene_env import SceneEnv

Info = dict[str, Array]
Pair = tuple[int | None, int | None]  # ids of subject and place


class Task:
    """Success condition, dense reward, observations and scripted solution of one task in an environment.

    The first axis of every array is the number of parallel environments, b. Arrays are NumPy arrays or torch tensors
    (see `simrecon_envs.arrays`). Positions are in world space, distances in metres.
    """

    kind: ClassVar[str]  # the first word of the task's name
    subjects: ClassVar[bool] = True  # False: the task is about the whole scene and names no object
    joint: ClassVar[str] = ""  # between subject and place in the name, such as "_on_"; empty: no place
    sentence: ClassVar[str]  # the instruction, with "{subject}" and "{place}" for the objects' names
    max_reward: float  # of a step with success
    mobile_only: ClassVar[bool] = False  # True: for robots that drive; placed by `plan`, not `interests`
    lasting: ClassVar[bool] = True  # a stage of this kind must still hold at the end of a composite

    # ---- Which tasks of this kind a scene has. These run without a simulator.

    @classmethod
    def options(cls, facts: SceneFacts) -> list[Pair]:
        """Return the candidates as pairs (subject, place), the easiest first."""
        return [(target.id, None) for target in facts.ranked]

    @classmethod
    def problems(cls, facts: SceneFacts, subject: int | None, place: int | None) -> list[str]:
        """Return the reasons why a candidate is likely infeasible; empty where none is known."""
        return subject_problems(facts, subject)

    @classmethod
    def interests(cls, facts: SceneFacts, spec: TaskSpec) -> list[np.ndarray]:
        """Return arrays of hand positions (k, 3). The robot is placed to reach the subject and one of each array."""
        return []

    @classmethod
    def things(cls, facts: SceneFacts) -> list[int]:
        """Return the ids of the objects that a task without a subject moves, the easiest first."""
        raise NotImplementedError

    @classmethod
    def plan(cls, facts: SceneFacts, spec: TaskSpec) -> Placement:
        """Return where a robot that drives is placed; only for kinds that are `mobile_only`."""
        raise NotImplementedError

    @classmethod
    def words(cls, facts: SceneFacts, spec: TaskSpec) -> str:
        """Return the instruction, for any robot."""
        names = {"subject": spec.subject, "place": spec.place}
        return cls.sentence.format(**{k: facts.thing(key) for k, key in names.items() if key is not None})

    # ---- One task in an environment.

    def __init__(self, env: "SceneEnv", spec: TaskSpec, placement: Placement) -> None:
        """Make a task for a placed robot; the simulator does not exist yet."""
        self.env, self.spec, self.placement = env, spec, placement
        self.facts: SceneFacts = env.facts
        self._concerned = tuple(key for key in (spec.subject, spec.place) if key in self.facts.targets)
        self.prepare()

    def prepare(self) -> None:
        """Compute what depends on `facts` and `placement`, such as goals within reach; called once, by `__init__`."""

    @property
    def subject(self) -> int:
        """Return the id of the subject."""
        return self.spec.subject_id

    @property
    def place(self) -> int:
        """Return the id of the place."""
        return self.spec.place_id

    @property
    def instruction(self) -> str:
        """Return the instruction for this environment."""
        return self.words(self.facts, self.spec)

    def start(self, env_idx: torch.Tensor, rng: Any) -> None:
        """Begin an episode in the environments `env_idx`; objects are at their initial poses.

        Args:
            env_idx: Indices (n,) of the environments.
            rng: ManiSkill's batched generator, for `draw`.
        """

    def evaluate(self) -> Info:
        """Return "success" (b,), a bool, and the quantities that it is computed from."""
        raise NotImplementedError

    def reward(self, info: Info) -> Array:
        """Return the dense reward (b,), 0 to `max_reward`; `max_reward` exactly where `info["success"]`."""
        raise NotImplementedError

    def observe(self, info: Info) -> dict[str, Array]:
        """Return the task's part of the observation, arrays (b, k)."""
        return {}

    def script(self, hand: Hand) -> Iterator[np.ndarray]:
        """Yield actions that solve the task, one per control step. `Oracle` runs them."""
        raise NotImplementedError

    # ---- Helpers.

    def _while_still(self, name: str, compute: Callable[[], Any]) -> Any:
        """Return `compute()`, cached until subject or place moves.

        Apart from their poses, the result may only depend on what `start` sets.
        """
        return self.env.measures.while_still((id(self), name), self._concerned, compute)

    def _undisturbed(self, compute: Callable[[], Info]) -> Info:
        """Return `compute()`, cached while subject and place sleep and the hand is far from the subject.

        `tcp_to_target_m` is always current.
        """
        measures = self.env.measures
        info = measures.undisturbed((id(self), "undisturbed"), self.subject, self._concerned, compute)
        return {**info, "tcp_to_target_m": measures.tcp_distance(self.subject)}

    def _zeros(self, width: int) -> Array:
        return self.env.measures.array(np.zeros((self.env.num_envs, width)))


def subject_problems(facts: SceneFacts, subject: int | None) -> list[str]:
    """Return the reasons why the robot cannot lift an object."""
    if subject in facts.targets:
        target = facts.targets[subject]
        return [target.problem] if target.problem else []
    return [
        f"{facts.thing(subject)} cannot move" if subject in facts.labels else f"there is no object {subject}"
    ]


def draw(rng: Any, env_idx: torch.Tensor, width: int) -> np.ndarray:
    """Return uniform samples in [0, 1) (len(env_idx), width) from ManiSkill's batched generator."""
    index = env_idx.cpu().numpy()
    return np.asarray(rng[index].uniform(size=width), np.float64).reshape(len(index), width)


def nearness(distance: Array) -> Array:
    """Return 1 - tanh(5 distance): 1 at 0 m, 0.5 at 11 cm, as in ManiSkill's tasks."""
    return 1 - tanh(5.0 * distance)
