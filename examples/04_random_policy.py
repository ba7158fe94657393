"""Run a random policy with the Gymnasium API (NumPy, not batched), or record a scripted pick as a video.

python examples/04_random_policy.py --env-id SimRecon/scene0001 --steps 500
python examples/04_random_policy.py --env-id SimRecon/scene0001 --video rollout.mp4   # needs a Vulkan driver
"""

import argparse
import time

import simrecon_envs


def main() -> None:
    """Parse the arguments and step."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--env-id", default="SimRecon/scene0001")
    parser.add_argument("--registry", default=None, help="folder of the registry, if not the default")
    parser.add_argument("--robot", default="panda")
    parser.add_argument("--steps", type=int, default=500)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--video", default=None, help="record a scripted pick to this file instead")
    arguments = parser.parse_args()

    if arguments.video:
        from simrecon_envs.rollout import record_rollout

        print(
            record_rollout(
                arguments.env_id,
                arguments.video,
                steps=min(arguments.steps, 100),
                seed=arguments.seed,
                robot=arguments.robot,
                registry=arguments.registry,
            )
        )
        return

    env = simrecon_envs.make_cpu(arguments.env_id, registry=arguments.registry, robot_uids=arguments.robot)
    obs, info = env.reset(seed=arguments.seed)
    env.action_space.seed(arguments.seed)
    print(f"{info['instruction'] or 'no task'} Observation {obs.shape}, action {env.action_space.shape}.")
    start, total, episodes = time.perf_counter(), 0.0, 0
    for _ in range(arguments.steps):
        obs, reward, terminated, truncated, info = env.step(env.action_space.sample())
        total += reward
        if terminated or truncated:
            episodes += 1
            env.reset()
    rate = arguments.steps / (time.perf_counter() - start)
    print(f"{arguments.steps} steps, {episodes} episodes ended, mean reward {total / arguments.steps:.3f}")
    print(f"{rate:.0f} steps/s")
    env.close()


if __name__ == "__main__":
    main()
