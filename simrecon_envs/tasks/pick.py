"""Pick: grip an object, lift it by 10 cm, and hold it still."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from simrecon_envs.arrays import Array, clamp, column, component, real, where
from simrecon_envs.oracle import Hand
from simrecon_envs.tasks.base import Info, Task, nearness


@dataclass(frozen=True)
class PickTaskConfig:
    """Thresholds of success."""

    lift_m: float = 0.10
    """Least height of the object above its initial height."""
    max_joint_speed: float = 0.2
    """Greatest speed of a robot joint (rad/s or m/s), as in ManiSkill's tasks."""
    max_target_speed_m_s: float = 0.2
    """Greatest speed of the object."""


class Pick(Task):
    """Success: held between the fingers, 10 cm above its initial height, object and robot still."""

    kind = "pick"
    sentence = "Pick up the {subject}."
    max_reward = 5.0
    lasting = False

    @property
    def config(self) -> PickTaskConfig:
        """Return the thresholds."""
        return self.env.task_config

    def start(self, env_idx: torch.Tensor, rng: Any) -> None:
        """Store the initial position."""
        if not hasattr(self, "_home"):
            self._home = self._zeros(3)
        self._home[env_idx] = self.env.measures.position(self.subject)[env_idx]

    def evaluate(self) -> Info:
        """Return success: held, lifted, still."""
        measures, config = self.env.measures, self.config
        lift = self._while_still("lift", self._lift_m)
        held = measures.held(self.subject)
        lifted = lift >= config.lift_m
        speed = measures.speeds(self.subject)[0]
        still = (measures.joint_speed <= config.max_joint_speed) & (speed <= config.max_target_speed_m_s)
        return {
            "success": held & lifted & still,
            "is_grasped": held,
            "is_lifted": lifted,
            "is_still": still,
            "lift_m": lift,
            "tcp_to_target_m": measures.tcp_distance(self.subject),
        }

    def _lift_m(self) -> Array:
        return component(self.env.measures.position(self.subject), 2) - component(self._home, 2)

    def reward(self, info: Info) -> Array:
        """Return 0 to 1 for reaching, plus 1 for holding, 0 to 2 for lifting, 1 for keeping still."""
        held = real(info["is_grasped"])
        lift = clamp(info["lift_m"] / self.config.lift_m, 0.0, 1.0)
        done = held * real(info["is_lifted"]) * real(info["is_still"])
        reward = nearness(info["tcp_to_target_m"]) + held * (1.0 + 2.0 * lift) + done
        return where(info["success"], self.max_reward, reward)

    def observe(self, info: Info) -> dict[str, Array]:
        """Return the object's pose, its lift, and the vector from the hand."""
        pose = self.env.measures.pose(self.subject)
        return {
            "is_grasped": column(info["is_grasped"]),
            "target_pose": pose,
            "tcp_to_target": pose[:, :3] - self.env.measures.tip,
            "target_lift": column(info["lift_m"]),
        }

    def script(self, hand: Hand) -> Iterator[np.ndarray]:
        """Grip, lift, wait."""
        yield from hand.grip(self.subject)
        yield from hand.lift(self.config.lift_m + 0.12)
        yield from hand.wait(30)
