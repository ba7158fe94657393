"""Base class of place, put, stack and restore: carry an object to a goal and release it."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import torch

from simrecon_envs.arrays import Array, column, norm, numpy, real, surely_not, where
from simrecon_envs.oracle import Hand
from simrecon_envs.tasks.base import Info, Task, draw, nearness, subject_problems
from simrecon_envs.tasks.facts import SceneFacts
from simrecon_envs.tasks.spec import TaskSpec

ABOVE_GOAL_M = 0.02  # height above the goal at which the script opens the hand
OVER_THINGS_M = 0.12  # height above the goal at which the object is carried over obstacles
_NEAR_GOAL_M = 0.05
_FREE_CHOICE = 24  # goals are drawn from this many of the roomiest reachable ones


class Carry(Task):
    """Success: the object is at its goal (`_arrived`), at rest, not held."""

    max_reward = 6.0

    @classmethod
    def problems(cls, facts: SceneFacts, subject: int | None, place: int | None) -> list[str]:
        """Return the reasons why the object cannot be lifted, or not be put down at the place."""
        problems = subject_problems(facts, subject)
        if subject not in facts.targets:
            return problems
        assert place is not None
        if place == subject or place in facts.above(subject):
            return [*problems, "it cannot stand on itself"]
        if not problems and not len(cls._goals(facts, TaskSpec("", "", subject, place))):
            problems.append(f"there is no room for it at the {facts.thing(place)}")
        return problems

    @classmethod
    def interests(cls, facts: SceneFacts, spec: TaskSpec) -> list[np.ndarray]:
        """Return the hand positions over the goals."""
        return [facts.hand_over(spec.subject_id, cls._goals(facts, spec))]

    @classmethod
    def _goals(cls, facts: SceneFacts, spec: TaskSpec) -> np.ndarray:
        """Return goals (k, 3) for the bottom center of the object's box, the best first."""
        return facts.spots(spec.place_id, spec.subject_id)

    def prepare(self) -> None:
        """Keep the goals that the placed robot reaches; all of them where it reaches none."""
        goals = self._goals(self.facts, self.spec)
        mask = self.placement.reaches(self.facts.hand_over(self.subject, goals), self.facts.traits)
        self.goals = (goals[mask] if mask.any() else goals)[:_FREE_CHOICE]
        if not len(self.goals):
            self.goals = self.facts.targets[self.subject].center[None] * [1, 1, 0]

    def start(self, env_idx: torch.Tensor, rng: Any) -> None:
        """Draw a goal."""
        if not hasattr(self, "goal"):
            self.goal = self._zeros(3)
        chosen = (draw(rng, env_idx, 1)[:, 0] * len(self.goals)).astype(int)
        bottom = self.env.measures.array(self.goals[chosen])
        bottom[:, 2] += self.facts.height_m(self.subject) / 2
        self.goal[env_idx] = bottom

    def live_goal(self) -> Array:
        """Return the goal (b, 3) of the object's box center; it moves with the place where that can move."""
        return self.goal

    def _arrived(self) -> Info:
        """Return "is_there" (b,), whether the object is at its goal, and what it is computed from."""
        raise NotImplementedError

    def evaluate(self) -> Info:
        """Return success: arrived, at rest, not held."""
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
        """Return 0 to 1 for reaching the object, 2 to 4 for carrying it, 4 to 5 for releasing it at the goal."""
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
        """Return the length (b,) of the way to the goal: sideways at carrying height, then down.

        The straight line would lead through obstacles.
        """
        position, goal = self.env.measures.position(self.subject), self.live_goal()
        aside = norm(position[:, :2] - goal[:, :2])
        height = goal[:, 2] + where(aside > _NEAR_GOAL_M, OVER_THINGS_M, ABOVE_GOAL_M / 2)
        return aside + abs(position[:, 2] - height)

    def _to_goal_m(self) -> Array:
        return norm(self.env.measures.position(self.subject) - self.live_goal())

    def observe(self, info: Info) -> dict[str, Array]:
        """Return the object's pose, the goal, and the vectors between hand, object and goal."""
        measures = self.env.measures
        pose, goal = measures.pose(self.subject), self.live_goal()
        return {
            "is_grasped": column(info["is_grasped"]),
            "target_pose": pose,
            "tcp_to_target": pose[:, :3] - measures.tip,
            "goal_position": goal,
            "target_to_goal": self._while_still("way", lambda: goal - pose[:, :3]),
        }

    def script(self, hand: Hand) -> Iterator[np.ndarray]:
        """Grip, lift, carry over obstacles, release, wait until it rests."""
        yield from hand.grip(self.subject)
        yield from hand.lift(OVER_THINGS_M + 0.03)
        yield from hand.carry(self.subject, lambda: numpy(self.live_goal())[0], OVER_THINGS_M, ABOVE_GOAL_M)
        yield from hand.let_go()
        yield from hand.wait(30)
