"""Train PPO of stable-baselines3 on a task of a scene: short, to show that everything fits together.

You will see the mean reward of an episode rise as the hand learns to come near the target. Reaching takes tens of
thousands of steps, picking up some millions: use more environments (`--envs`, one process each) and a longer run.

    python examples/05_train_ppo.py --env-id SimRecon/scene0001 --task reach --steps 4000
"""

import argparse

from stable_baselines3 import PPO
from stable_baselines3.common.evaluation import evaluate_policy

import simrecon_envs


def main() -> None:
    """Parse the arguments and train."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--env-id", default="SimRecon/scene0001")
    parser.add_argument(
        "--registry", default=None, help="the registry's folder; the default registry if left out"
    )
    parser.add_argument("--robot", default="panda")
    parser.add_argument("--task", default="reach", help="a kind of task or a task's name")
    parser.add_argument("--steps", type=int, default=4000)
    parser.add_argument("--envs", type=int, default=1, help="environments in parallel, one process each")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", default=None, help="where to save the policy (.zip)")
    arguments = parser.parse_args()

    env = simrecon_envs.make_vec(
        arguments.env_id,
        arguments.envs,
        kind="sb3",
        seed=arguments.seed,
        registry=arguments.registry,
        robot_uids=arguments.robot,
        task=arguments.task,
        control_mode="pd_joint_delta_pos",
        max_episode_steps=100,
    )
    n_steps = min(256, max(arguments.steps // arguments.envs, 32))
    model = PPO(
        "MlpPolicy",
        env,
        n_steps=n_steps,
        batch_size=min(128, n_steps * arguments.envs),
        learning_rate=1e-3,
        gamma=0.9,
        seed=arguments.seed,
        device="cpu",
        verbose=1,
    )
    model.learn(arguments.steps)
    mean, std = evaluate_policy(model, env, n_eval_episodes=3, deterministic=True)
    print(f"return of an episode after training: {mean:.2f} +- {std:.2f} (100 is the most)")
    if arguments.out:
        model.save(arguments.out)
    env.close()


if __name__ == "__main__":
    main()
