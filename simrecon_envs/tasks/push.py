"""Push: move an object along its support to a goal, without lifting it."""

from collections.abc import Iterator

import numpy as np
import torch

from simrecon_envs.arrays import Array, clamp, norm, numpy, real, surely_not, where
from simrecon_envs.tasks.base import Info, Task, draw, nearness
from simrecon_envs.tasks.facts import SceneFacts
from simrecon_envs.tasks.spec import TaskSpec

WITHIN_M = 0.035
_DISTANCES_M = (0.10, 0.20)
_UPRIGHT = 0.94
_MAX_PUSHED_KG = 5.0
_SLIM = 2.6  # times as high as what it stands on is wide
HAND_BEHIND_M = 0.052  # from the object's outline to the middle of closed fingers, before they push


class Push(Task):
    """The object's middle within 3.5 cm of the goal on its support, upright, at rest, carried by that support."""

    kind = "push"
    max_reward = 4.0

    @classmethod
    def problems(cls, facts: SceneFacts, subject: int | None, place: int | None) -> list[str]:
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
        goals = cls._goals(facts, spec.subject)
        return [goals, _behind(facts, spec.subject, goals)]

    @classmethod
    def _goals(cls, facts: SceneFacts, subject: int) -> np.ndarray:
        """Return goals (k, 3): level spots 10 to 20 cm away with a free way there, and room behind the object."""
        support = facts.parent.get(subject)
        spots = facts.spots(support, subject)
        if not len(spots):
            return spots
        target = facts.targets[subject]
        middle = target.center[:2]
        away = np.linalg.norm(spots[:, :2] - middle, axis=1)
        keep = (
            (away >= _DISTANCES_M[0])
            & (away <= _DISTANCES_M[1])
            & (np.abs(spots[:, 2] - target.bottom_m) < 0.01)
        )
        ordered = spots[keep]
        near = {tuple(cell) for cell in np.floor(spots[:, :2] / 0.03).astype(int)}
        free = []
        for spot in ordered:
            along = middle + np.linspace(0.35, 1.0, 6)[:, None] * (spot[:2] - middle)
            if all(_touches(near, cell) for cell in np.floor(along / 0.03).astype(int)):
                free.append(spot)
        return np.array(free).reshape(-1, 3)

    def __init__(self, env: object, spec: TaskSpec, placement: object) -> None:
        super().__init__(env, spec, placement)
        self._support = self.facts.parent[spec.subject]
        goals = self._goals(self.facts, spec.subject)
        traits = self.facts.traits
        mask = placement.reaches(goals, traits)
        goals = goals[mask] if mask.any() else goals
        mask = placement.reaches(_behind(self.facts, spec.subject, goals), traits)
        goals = goals[mask] if mask.any() else goals
        # Away from the robot or across: the hand comes from behind, and pulling is no pushing.
        outward = np.array([np.cos(placement.yaw_rad), np.sin(placement.yaw_rad)])
        middle = self.facts.targets[spec.subject].center[:2]
        forward = (goals[:, :2] - middle) @ outward
        order = np.argsort(-(forward > -0.03).astype(int), kind="stable")
        good = goals[order][: max(int((forward > -0.03).sum()), 1)]
        self.goals = good[:24] if len(good) else self.facts.targets[spec.subject].center[None]

    @classmethod
    def words(cls, facts: SceneFacts, spec: TaskSpec) -> str:
        return f"Push the {facts.thing(spec.subject)} to the goal."

    def start(self, env_idx: torch.Tensor, rng: object) -> None:
        if not hasattr(self, "goal"):
            self.goal, self._home = self._zeros(3), self._zeros(3)
        chosen = (draw(rng, env_idx, 1)[:, 0] * len(self.goals)).astype(int)
        self._home[env_idx] = self.env.measures.position(self.subject)[env_idx]
        goal = self.env.measures.array(self.goals[chosen])
        goal[:, 2] = self._home[env_idx, 2]
        self.goal[env_idx] = goal

    def evaluate(self) -> Info:
        return self._undisturbed(self._judge)

    def _judge(self) -> Info:
        measures = self.env.measures
        away, near, upright = self._while_still("place", self._place)
        rest, held = measures.at_rest(self.subject), measures.held(self.subject)
        success = near & upright & rest & ~held
        if not surely_not(success):  # contacts are asked for only where they decide
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
        upright = real(info["is_upright"])
        progress = self._while_still("progress", lambda: self._progress(info))
        reward = clamp(0.5 * nearness(info["tcp_to_target_m"]) + 2.0 * progress * upright, 0.0)
        reward = reward + real(info["is_near"] & info["is_upright"])
        return where(info["success"], self.max_reward, reward)

    def _progress(self, info: Info) -> Array:
        start = clamp(norm((self._home - self.goal)[:, :2]), 1e-3)
        return clamp(1 - info["target_to_goal_m"] / start, -1.0, 1.0)

    def observe(self, info: Info) -> dict[str, Array]:
        measures = self.env.measures
        pose = measures.pose(self.subject)
        return {
            "target_pose": pose,
            "tcp_to_target": pose[:, :3] - measures.tip,
            "goal_position": self.goal,
            "target_to_goal": self._while_still("way", lambda: self.goal - pose[:, :3]),
        }

    def script(self, hand: "Hand") -> Iterator[np.ndarray]:  # noqa: F821
        for _ in range(3):  # from another side, where the first way went past the goal
            yield from hand.push(self.subject, lambda: numpy(self.goal)[0], 0.4 * WITHIN_M)
            yield from hand.lift(0.10)
            yield from hand.wait(15)


def _behind(facts: SceneFacts, subject: int, goals: np.ndarray) -> np.ndarray:
    """Return from where (k, 3) the hand pushes an object to each of the goals (k, 3)."""
    target = facts.targets[subject]
    way = (target.center - goals) * [1, 1, 0]
    way /= np.linalg.norm(way, axis=1, keepdims=True).clip(1e-6)
    return target.center + (facts.radius_m(subject) + HAND_BEHIND_M) * way


def _touches(near: set[tuple[int, int]], cell: np.ndarray) -> bool:
    return any((cell[0] + dx, cell[1] + dy) in near for dx in (-1, 0, 1) for dy in (-1, 0, 1))
