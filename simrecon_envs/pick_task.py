"""Pick up a named object: when it is done, and the reward on the way there. Batched torch."""

from dataclasses import dataclass

import torch


@dataclass(frozen=True)
class PickTaskConfig:
    """When a target counts as picked up."""

    lift_m: float = 0.10
    """How far above its initial height the target must be."""
    max_joint_speed: float = 0.2
    """How still the robot must be (rad/s or m/s), as in ManiSkill's own tasks."""
    max_target_speed_m_s: float = 0.2
    """How still the target must be."""


MAX_DENSE_REWARD = 5.0


def evaluate_pick(env: object, config: PickTaskConfig) -> dict[str, torch.Tensor]:
    """Return what the task knows of the present state; every value has shape (num_envs,).

    Args:
        env: The `SceneEnv`; its target's actor, initial height and agent are read.
        config: The thresholds.
    """
    position, velocity = env.target_position, env.target_actor.linear_velocity
    lift = position[:, 2] - env.target_initial_height
    distance = torch.linalg.norm(position - env.agent.tcp.pose.p, dim=1)
    grasped = env.agent.is_grasping(env.target_actor)
    speed = torch.linalg.norm(velocity, dim=1)
    joint_speed = torch.abs(env.agent.robot.get_qvel()).amax(dim=1)
    lifted = lift >= config.lift_m
    still = (joint_speed <= config.max_joint_speed) & (speed <= config.max_target_speed_m_s)
    return {
        "success": grasped & lifted & still,
        "is_grasped": grasped,
        "is_lifted": lifted,
        "is_still": still,
        "lift_m": lift,
        "tcp_to_target_m": distance,
    }


def dense_pick_reward(info: dict[str, torch.Tensor], config: PickTaskConfig) -> torch.Tensor:
    """Return a reward (num_envs,) between 0 and `MAX_DENSE_REWARD`: reach, grasp, lift, keep still."""
    grasped = info["is_grasped"].float()
    reach = 1 - torch.tanh(5.0 * info["tcp_to_target_m"])
    lift = torch.clamp(info["lift_m"] / config.lift_m, 0.0, 1.0)
    done = grasped * info["is_lifted"].float() * info["is_still"].float()
    reward = reach + grasped * (1.0 + 2.0 * lift) + done
    return torch.where(info["success"], torch.full_like(reward, MAX_DENSE_REWARD), reward)
