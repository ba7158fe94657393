"""Pick: grip an object, lift it by 10 cm, and keep still."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch

from simrecon_envs.arrays import Array, clamp, column, component, real, where
from simrecon_envs.tasks.base import Info, Task, nearness
from simrecon_envs.tasks.facts import SceneFacts
from simrecon_envs.tasks.spec import TaskSpec


@dataclass(frozen=True)
class PickTaskConfig:
    """When a target counts as picked up."""

    lift_m: float = 0.10
    """How far above its initial height the target must be."""
    max_joint_speed: float = 0.2
    """How still the robot must be (rad/s or m/s), as in ManiSkill's own tasks."""
    max_target_speed_m_s: float = 0.2
    """How still the target must be."""


class Pick(Task):
    """The object held between the fingers, 10 cm above where it stood, everything still."""

    kind = "pick"
    max_reward = 5.0
    lasting = False

    @classmethod
    def words(cls, facts: SceneFacts, spec: TaskSpec) -> str:
        return f"Pick up the {facts.thing(spec.subject)}."

    @property
    def config(self) -> PickTaskConfig:
        """Return the thresholds."""
        return self.env.task_config

    def start(self, env_idx: torch.Tensor, rng: object) -> None:
        if not hasattr(self, "_home"):
            self._home = self._zeros(3)
        self._home[env_idx] = self.env.measures.position(self.subject)[env_idx]

    def evaluate(self) -> Info:
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
        held = real(info["is_grasped"])
        lift = clamp(info["lift_m"] / self.config.lift_m, 0.0, 1.0)
        done = held * real(info["is_lifted"]) * real(info["is_still"])
        reward = nearness(info["tcp_to_target_m"]) + held * (1.0 + 2.0 * lift) + done
        return where(info["success"], self.max_reward, reward)

    def observe(self, info: Info) -> dict[str, Array]:
        pose = self.env.measures.pose(self.subject)
        return {
            "is_grasped": column(info["is_grasped"]),
            "target_pose": pose,
            "tcp_to_target": pose[:, :3] - self.env.measures.tip,
            "target_lift": column(info["lift_m"]),
        }

    def script(self, hand: "Hand") -> Iterator[np.ndarray]:  # noqa: F821
        yield from hand.grip(self.subject)
        yield from hand.lift(self.config.lift_m + 0.12)
        yield from hand.wait(30)
