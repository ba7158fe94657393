"""What placing, putting, stacking and rearranging share: an object is carried to a goal and let go there."""

from collections.abc import Iterator

import numpy as np
import torch

from simrecon_envs.arrays import Array, column, norm, numpy, real, surely_not, where
from simrecon_envs.tasks.base import Info, Task, draw, nearness, subject_problems
from simrecon_envs.tasks.facts import SceneFacts
from simrecon_envs.tasks.spec import TaskSpec

ABOVE_GOAL_M = 0.02  # where it is let go from
OVER_THINGS_M = 0.12  # how high it is carried over what stands about
_NEAR_GOAL_M = 0.05
_FREE_CHOICE = 24  # goals drawn from are the roomiest of those within reach


class Carry(Task):
    """Success is physical: `_arrived` says where, and in all kinds the object rests and nobody holds it.

    The reward's steps: reach (0 to 1), hold and carry (2 to 4), let go at the goal (4 to 5), success (6).
    """

    max_reward = 6.0

    @classmethod
    def problems(cls, facts: SceneFacts, subject: int | None, place: int | None) -> list[str]:
        """Return why the object cannot be lifted, or why it cannot be put down there."""
        problems = subject_problems(facts, subject)
        if subject not in facts.targets:
            return problems
        if place == subject or place in facts.above(subject):
            return [*problems, "it cannot stand on itself"]
        if not problems and not len(cls._goals(facts, TaskSpec("", "", subject, place))):
            problems.append(f"there is no room for it at the {facts.thing(place)}")
        return problems

    @classmethod
    def interests(cls, facts: SceneFacts, spec: TaskSpec) -> list[np.ndarray]:
        return [facts.hand_over(spec.subject, cls._goals(facts, spec))]

    @classmethod
    def _goals(cls, facts: SceneFacts, spec: TaskSpec) -> np.ndarray:
        """Return where the bottom of the object's box may go (k, 3), the best first."""
        return facts.spots(spec.place, spec.subject)

    def __init__(self, env: object, spec: TaskSpec, placement: object) -> None:
        super().__init__(env, spec, placement)
        goals = self._goals(self.facts, spec)
        mask = placement.reaches(self.facts.hand_over(spec.subject, goals), self.facts.traits)
        self.goals = (goals[mask] if mask.any() else goals)[:_FREE_CHOICE]
        if not len(self.goals):
            self.goals = self.facts.targets[spec.subject].center[None] * [1, 1, 0]

    def start(self, env_idx: torch.Tensor, rng: object) -> None:
        if not hasattr(self, "goal"):
            self.goal, self._home = self._zeros(3), self._zeros(3)
        chosen = (draw(rng, env_idx, 1)[:, 0] * len(self.goals)).astype(int)
        bottom = self.env.measures.array(self.goals[chosen])
        bottom[:, 2] += self.facts.height_m(self.subject) / 2
        self.goal[env_idx] = bottom
        self._home[env_idx] = self.env.measures.position(self.subject)[env_idx]

    def live_goal(self) -> Array:
        """Return where the object's box centre should come to rest (b, 3)."""
        return self.goal

    def _arrived(self) -> Info:
        """Return "is_there" (b,) and what it depends on: whether the object is where it should be."""
        raise NotImplementedError

    def evaluate(self) -> Info:
        return self._undisturbed(self._judge)

    def _judge(self) -> Info:
        measures = self.env.measures
        held = measures.held(self.subject)
        rest = measures.at_rest(self.subject)
        there = self._arrived()
        return {
            **there,
            "success": there["is_there"] & rest & ~held,
            "is_grasped": held,
            "is_at_rest": rest,
            "tcp_to_target_m": measures.tcp_distance(self.subject),
            "target_to_goal_m": self._while_still("away", self._to_goal_m),
        }

    def reward(self, info: Info) -> Array:
        near = (info["target_to_goal_m"] <= _NEAR_GOAL_M) | info["is_there"]
        if surely_not(info["is_grasped"] | near):
            return nearness(info["tcp_to_target_m"])
        held = real(info["is_grasped"])
        reward = nearness(info["tcp_to_target_m"]) * (1 - held)
        if not surely_not(info["is_grasped"]):
            reward = reward + held * (2 + 2 * nearness(self._way()))
        if not surely_not(near):
            reward = where(near, 4.0 + (1 - held) * (0.5 + 0.5 * real(info["is_at_rest"])), reward)
        return where(info["success"], self.max_reward, reward)

    def _way(self) -> Array:
        """Return how far (b,) the object has to be carried: first over the goal, then down to it.

        A straight line leads through what stands in between.
        """
        position, goal = self.env.measures.position(self.subject), self.live_goal()
        aside = norm(position[:, :2] - goal[:, :2])
        height = goal[:, 2] + where(aside > _NEAR_GOAL_M, OVER_THINGS_M, ABOVE_GOAL_M / 2)
        return aside + abs(position[:, 2] - height)

    def _to_goal_m(self) -> Array:
        return norm(self.env.measures.position(self.subject) - self.live_goal())

    def observe(self, info: Info) -> dict[str, Array]:
        measures = self.env.measures
        pose, goal = measures.pose(self.subject), self.live_goal()
        return {
            "is_grasped": column(info["is_grasped"]),
            "target_pose": pose,
            "tcp_to_target": pose[:, :3] - measures.tip,
            "goal_position": goal,
            "target_to_goal": self._while_still("way", lambda: goal - pose[:, :3]),
        }

    def script(self, hand: "Hand") -> Iterator[np.ndarray]:  # noqa: F821
        yield from hand.grip(self.subject)
        yield from hand.lift(OVER_THINGS_M + 0.03)
        yield from hand.carry(self.subject, lambda: numpy(self.live_goal())[0], OVER_THINGS_M, ABOVE_GOAL_M)
        yield from hand.let_go()
        yield from hand.wait(30)
