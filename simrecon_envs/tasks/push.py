"""Push: slide an object along its support to a goal."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import torch

from simrecon_envs.arrays import Array, clamp, norm, numpy, real, surely_not, where
from simrecon_envs.oracle import HAND_BEHIND_M, Hand
from simrecon_envs.tasks.base import Info, Task, draw, nearness
from simrecon_envs.tasks.facts import SceneFacts
from simrecon_envs.tasks.spec import TaskSpec

WITHIN_M = 0.035  # tolerance around the goal, horizontally
_DISTANCES_M = (0.10, 0.20)  # from the object to its goals
_UPRIGHT = 0.94  # least cosine between the object's up axis and the vertical
_MAX_PUSHED_KG = 5.0
_SLIM = 2.6  # greatest ratio of height to foot width; slimmer objects tip over


class Push(Task):
    """Success: the object within 3.5 cm of the goal, upright, at rest, carried by its support, not held."""

    kind = "push"
    sentence = "Push the {subject} to the goal."
    max_reward = 4.0

    @classmethod
    def problems(cls, facts: SceneFacts, subject: int | None, place: int | None) -> list[str]:
        """Return the reasons: loaded, too low, slim or heavy, no free way to a goal; no grasp is needed."""
        if subject not in facts.targets:
            return super().problems(facts, subject, place)
        problems = []
        height = facts.height_m(subject)
        if facts.above(subject):
            problems.append("something stands on it or hangs from it")
        if height < 0.03:
            problems.append(f"only {1000 * height:.0f} mm high")
        if height > _SLIM * facts.foot_width_m(subject):
            problems.append("so slim that it tips over")
        if facts.mass_kg[subject] > _MAX_PUSHED_KG:
            problems.append(f"weighs {facts.mass_kg[subject]:.1f} kg")
        if not problems and not len(cls._goals(facts, subject)):
            problems.append("there is no free way for it")
        return problems

    @classmethod
    def interests(cls, facts: SceneFacts, spec: TaskSpec) -> list[np.ndarray]:
        """Return the goals, and the hand positions behind the object."""
        goals = cls._goals(facts, spec.subject_id)
        return [goals, _behind(facts, spec.subject_id, goals)]

    @classmethod
    def _goals(cls, facts: SceneFacts, subject: int) -> np.ndarray:
        """Return goals (k, 3): free spots at the object's level, 10 to 20 cm away, with a free way to them."""
        spots = facts.spots(facts.parent[subject], subject)
        if not len(spots):
            return spots
        target = facts.targets[subject]
        middle = target.center[:2]
        away = np.linalg.norm(spots[:, :2] - middle, axis=1)
        level = np.abs(spots[:, 2] - target.bottom_m) < 0.01
        keep = (away >= _DISTANCES_M[0]) & (away <= _DISTANCES_M[1]) & level
        near = {tuple(cell) for cell in np.floor(spots[:, :2] / 0.03).astype(int)}
        free = []
        for spot in spots[keep]:
            along = middle + np.linspace(0.35, 1.0, 6)[:, None] * (spot[:2] - middle)
            if all(_touches(near, cell) for cell in np.floor(along / 0.03).astype(int)):
                free.append(spot)
        return np.array(free).reshape(-1, 3)

    def prepare(self) -> None:
        """Keep goals within reach for object and hand, away from the robot or across, where there are any."""
        self._support = self.facts.parent[self.subject]
        goals = self._goals(self.facts, self.subject)
        placement, traits = self.placement, self.facts.traits
        mask = placement.reaches(goals, traits)
        goals = goals[mask] if mask.any() else goals
        mask = placement.reaches(_behind(self.facts, self.subject, goals), traits)
        goals = goals[mask] if mask.any() else goals
        # Not towards the robot: the hand would have to pull.
        outward = np.array([np.cos(placement.yaw_rad), np.sin(placement.yaw_rad)])
        middle = self.facts.targets[self.subject].center[:2]
        forward = (goals[:, :2] - middle) @ outward
        order = np.argsort(-(forward > -0.03).astype(int), kind="stable")
        good = goals[order][: max(int((forward > -0.03).sum()), 1)]
        self.goals = good[:24] if len(good) else self.facts.targets[self.subject].center[None]

    def start(self, env_idx: torch.Tensor, rng: Any) -> None:
        """Draw a goal; store the initial position."""
        if not hasattr(self, "goal"):
            self.goal, self._home = self._zeros(3), self._zeros(3)
        chosen = (draw(rng, env_idx, 1)[:, 0] * len(self.goals)).astype(int)
        self._home[env_idx] = self.env.measures.position(self.subject)[env_idx]
        goal = self.env.measures.array(self.goals[chosen])
        goal[:, 2] = self._home[env_idx, 2]
        self.goal[env_idx] = goal

    def evaluate(self) -> Info:
        """Return success: near, upright, at rest, on its support, not held."""
        return self._undisturbed(self._judge)

    def _judge(self) -> Info:
        measures = self.env.measures
        away, near, upright = self._while_still("place", self._place)
        rest, held = measures.at_rest(self.subject), measures.held(self.subject)
        success = near & upright & rest & ~held
        if not surely_not(success):  # contacts are slow: read them only if they decide
            success = success & measures.rests_on(self.subject, self._support)
        return {
            "success": success,
            "is_near": near,
            "is_upright": upright,
            "is_at_rest": rest,
            "is_grasped": held,
            "target_to_goal_m": away,
            "tcp_to_target_m": measures.tcp_distance(self.subject),
        }

    def _place(self) -> tuple[Array, Array, Array]:
        measures = self.env.measures
        away = norm((measures.position(self.subject) - self.goal)[:, :2])
        return away, away <= WITHIN_M, measures.up(self.subject) >= _UPRIGHT

    def reward(self, info: Info) -> Array:
        """Return 0 to 0.5 for reaching, plus 0 to 2 for progress to the goal, 1 for standing there upright."""
        upright = real(info["is_upright"])
        progress = self._while_still("progress", lambda: self._progress(info))
        reward = clamp(0.5 * nearness(info["tcp_to_target_m"]) + 2.0 * progress * upright, 0.0)
        reward = reward + real(info["is_near"] & info["is_upright"])
        return where(info["success"], self.max_reward, reward)

    def _progress(self, info: Info) -> Array:
        start = clamp(norm((self._home - self.goal)[:, :2]), 1e-3)
        return clamp(1 - info["target_to_goal_m"] / start, -1.0, 1.0)

    def observe(self, info: Info) -> dict[str, Array]:
        """Return the object's pose, the goal, and the vectors between hand, object and goal."""
        measures = self.env.measures
        pose = measures.pose(self.subject)
        return {
            "target_pose": pose,
            "tcp_to_target": pose[:, :3] - measures.tip,
            "goal_position": self.goal,
            "target_to_goal": self._while_still("way", lambda: self.goal - pose[:, :3]),
        }

    def script(self, hand: Hand) -> Iterator[np.ndarray]:
        """Push up to three times, from another side where the object slid past the goal."""
        for _ in range(3):
            yield from hand.push(self.subject, lambda: numpy(self.goal)[0], 0.4 * WITHIN_M)
            yield from hand.lift(0.10)
            yield from hand.wait(15)


def _behind(facts: SceneFacts, subject: int, goals: np.ndarray) -> np.ndarray:
    """Return the hand positions (k, 3) behind an object from which it is pushed to goals (k, 3)."""
    target = facts.targets[subject]
    way = (target.center - goals) * [1, 1, 0]
    way /= np.linalg.norm(way, axis=1, keepdims=True).clip(1e-6)
    return target.center + (facts.radius_m(subject) + HAND_BEHIND_M) * way


def _touches(near: set[tuple[int, int]], cell: np.ndarray) -> bool:
    return any((cell[0] + dx, cell[1] + dy) in near for dx in (-1, 0, 1) for dy in (-1, 0, 1))
