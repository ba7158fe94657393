"""Reach: move the hand over an object without touching it, and hold still."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import torch

from simrecon_envs.arrays import Array, norm, numpy, real, tanh, where
from simrecon_envs.oracle import Hand
from simrecon_envs.tasks.base import Info, Task, nearness
from simrecon_envs.tasks.facts import SceneFacts

ABOVE_M = 0.05  # height of the goal over the object's top
WITHIN_M = 0.025  # tolerance around the goal
_OVER_M = 0.04  # height over the goal from which the script descends
STILL_RAD_S = 0.3
_ROOM_M = -0.015  # least room below the hand at the goal; negative: it may stop a little higher
TOUCHED_M = 0.03  # greatest displacement of an object that counts as untouched


class Reach(Task):
    """Success: the tool center point within 2.5 cm of 5 cm above the object, the robot still, the object unmoved."""

    kind = "reach"
    sentence = "Move the hand over the {subject}."
    max_reward = 3.0
    lasting = False

    @classmethod
    def problems(cls, facts: SceneFacts, subject: int | None, place: int | None) -> list[str]:
        """Return the reason: no room for the hand; no grasp is needed."""
        if subject not in facts.targets:
            return super().problems(facts, subject, place)
        room = facts.hover(subject, ABOVE_M).room_m > _ROOM_M
        return [] if room else ["there is no room for the hand over it"]

    def start(self, env_idx: torch.Tensor, rng: Any) -> None:
        """Store the initial position."""
        if not hasattr(self, "_home"):
            self._home, self._lift = self._zeros(3), self._zeros(3)
            self._lift[:, 2] = self.facts.height_m(self.subject) / 2 + ABOVE_M
        self._home[env_idx] = self.env.measures.position(self.subject)[env_idx]

    def _goal(self) -> Array:
        return self._while_still("goal", lambda: self.env.measures.position(self.subject) + self._lift)

    def _unmoved(self) -> Array:
        return norm(self.env.measures.position(self.subject) - self._home) <= TOUCHED_M

    def evaluate(self) -> Info:
        """Return success: near, still, object unmoved."""
        measures = self.env.measures
        distance = norm(self._goal() - measures.tip)
        still = measures.joint_speed <= STILL_RAD_S
        near, unmoved = distance <= WITHIN_M, self._while_still("unmoved", self._unmoved)
        return {"success": near & still & unmoved, "is_near": near, "is_still": still, "is_unmoved": unmoved,
                "tcp_to_goal_m": distance}  # fmt: skip

    def reward(self, info: Info) -> Array:
        """Return nearness 0 to 1 and, near the goal, slowness 0 to 1; half of it where the object was moved."""
        near = real(info["is_near"])
        slow = 1 - tanh(2.0 * self.env.measures.joint_speed)
        reward = (nearness(info["tcp_to_goal_m"]) + near * slow) * (0.5 + 0.5 * real(info["is_unmoved"]))
        return where(info["success"], self.max_reward, reward)

    def observe(self, info: Info) -> dict[str, Array]:
        """Return the object's pose and the vector from the hand to the goal."""
        measures = self.env.measures
        return {"target_pose": measures.pose(self.subject), "tcp_to_goal": self._goal() - measures.tip}

    def script(self, hand: Hand) -> Iterator[np.ndarray]:
        """Close the hand, rise, move over the goal, descend, wait."""
        hand.close()
        turned = self.facts.hover(self.subject, ABOVE_M).yaw_rad
        yield from hand.rise(float(numpy(self._goal())[0, 2]) + _OVER_M)
        over = numpy(self._goal())[0] + [0, 0, _OVER_M]
        yield from hand.go(lambda: over, within_m=0.02, yaw=lambda: turned, patience=50)
        yield from hand.go(lambda: numpy(self._goal())[0], within_m=0.008, yaw=lambda: turned)
        yield from hand.wait(20)
