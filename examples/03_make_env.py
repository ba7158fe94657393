"""Make the environment of a reconstructed scene, and take one step.

Prints the scene's tasks and objects, the instruction, and the shapes of the observations.

    python examples/03_make_env.py --env-id SimRecon/scene0001 --robot fetch
"""

import argparse

import gymnasium as gym

import simrecon_envs


def main() -> None:
    """Parse the arguments and make the environment."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--env-id", default="SimRecon/scene0001")
    parser.add_argument("--registry", default=None, help="folder of the registry, if not the default")
    parser.add_argument("--robot", default="panda")
    parser.add_argument(
        "--task", default="pick", help="a kind of task, or a name from the list that is printed"
    )
    arguments = parser.parse_args()

    # `import simrecon_envs` has registered the scenes of the default registry; this registers those of another one.
    print("registered:", ", ".join(simrecon_envs.register_scenes(arguments.registry)) or "nothing")
    # gym.make works, too; simrecon_envs.make also lists the scenes where the id is wrong.
    env: gym.Env = simrecon_envs.make(
        arguments.env_id,
        registry=arguments.registry,
        robot_uids=arguments.robot,
        task=arguments.task,
        obs_mode="state_dict",
    )
    for task in simrecon_envs.list_tasks(
        arguments.env_id, registry=arguments.registry, robot=arguments.robot
    ):
        print(f"  {task.id}: {task.instruction}")
    scene = env.unwrapped
    for item in scene.bundle.objects:
        kind = "movable" if scene.builder.objects[item.id].dynamic else "fixed"
        print(f"  object {item.id}: {item.label}, {item.mass_kg:.2f} kg, {kind}")
    print("task:", scene.instruction or "none", f"({scene.task_note})" if scene.task_note else "")

    obs, _ = env.reset(seed=0)
    for group, values in obs.items():
        for name, value in values.items():
            print(f"  obs {group}/{name}: {tuple(value.shape)} {value.dtype}")
    _, reward, _, _, info = env.step(env.action_space.sample())
    print(f"after one step: reward {float(reward):.3f}, success {bool(info.get('success', False))}")
    env.close()


if __name__ == "__main__":
    main()
