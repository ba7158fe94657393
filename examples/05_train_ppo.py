"""Train PPO of stable-baselines3 on a task of a scene.

`simrecon train SCENE --task reach` adds checkpoints, TensorBoard, an evaluation and a video. Start from this file to
change the training. Two things matter. Success ends an episode, so it pays the discounted reward of staying successful;
else hovering near the goal pays more. And observations are normalized. The same seed gives the same policy.

    python examples/05_train_ppo.py --env-id SimRecon/scene0001 --task reach
"""

import argparse
import functools
import hashlib

import gymnasium as gym
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize

import simrecon_envs

GAMMA = 0.9


class SuccessPays(gym.Wrapper):
    """Adds the discounted reward of staying successful for ever, and reports success to stable-baselines3."""

    def step(self, action):
        """Step."""
        obs, reward, terminated, truncated, info = self.env.step(action)
        success = bool(info["success"])
        bonus = GAMMA / (1 - GAMMA) if terminated and success else 0.0
        return obs, reward + bonus, terminated, truncated, {"is_success": success}


def make_env(scene: str, registry: str | None, task: str, robot: str) -> gym.Env:
    """Make one environment; runs in each process."""
    torch.set_num_threads(1)
    env = simrecon_envs.make_cpu(
        scene,
        registry=registry,
        task=task,
        robot_uids=robot,
        control_mode="pd_ee_delta_pos",  # displacement of the hand, and the fingers
        observe_objects=False,  # the task's own observations suffice
        randomize="start",  # random poses of objects and robot at reset
        max_episode_steps=100,
    )
    return Monitor(SuccessPays(env), info_keywords=("is_success",))


def main() -> None:
    """Train, and count successes on seeds that training did not use."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--env-id", default="SimRecon/scene0001")
    parser.add_argument("--registry", default=None, help="folder of the registry, if not the default")
    parser.add_argument("--robot", default="panda")
    parser.add_argument("--task", default="reach", help="a kind of task or a task's name")
    parser.add_argument("--steps", type=int, default=50_000)
    parser.add_argument("--envs", type=int, default=2, help="environments in parallel, one process each")
    parser.add_argument("--episodes", type=int, default=50, help="to evaluate with")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", default=None, help="where to save the policy (.zip)")
    arguments = parser.parse_args()

    torch.set_num_threads(1)
    maker = functools.partial(make_env, arguments.env_id, arguments.registry, arguments.task, arguments.robot)
    # spawn: a simulator cannot be forked.
    many = [maker] * arguments.envs
    vec = SubprocVecEnv(many, start_method="spawn") if arguments.envs > 1 else DummyVecEnv(many)
    env = VecNormalize(vec, gamma=GAMMA)
    model = PPO(
        "MlpPolicy",
        env,
        n_steps=max(min(1000, arguments.steps) // arguments.envs, 2),
        batch_size=100,
        learning_rate=1e-3,
        gamma=GAMMA,
        gae_lambda=0.9,
        target_kl=0.05,
        policy_kwargs={"log_std_init": -1.0},
        seed=arguments.seed,
        device="cpu",
        verbose=1,
    )
    model.learn(arguments.steps)

    env.training = env.norm_reward = False
    env.seed(10**9)
    successes: list[bool] = []
    evaluate_policy(
        model,
        env,
        n_eval_episodes=arguments.episodes,
        callback=lambda at, _: successes.append(at["info"]["is_success"]) if at["done"] else None,
    )
    env.close()
    weights = b"".join(value.numpy().tobytes() for value in model.policy.state_dict().values())
    print(f"policy {hashlib.sha256(weights).hexdigest()[:16]}")
    print(f"success: {sum(successes)} of {len(successes)} episodes")
    if arguments.out:
        model.save(arguments.out)
        env.save(f"{arguments.out}.normalization.pkl")


if __name__ == "__main__":
    main()
