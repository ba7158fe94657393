"""Arguments of `gym.make` that cannot work, and calls after `close`: one clear error, before the simulator is built."""

import time
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

import simrecon_envs
from registry import SimReconError, UsageError

WRONG: dict[str, tuple[dict, str]] = {
    "no environments": ({"num_envs": 0}, "num_envs 0: expected a whole number, at least 1"),
    "fewer than none": ({"num_envs": -2}, "num_envs -2"),
    "half an environment": ({"num_envs": 1.5}, "num_envs 1.5"),
    "words for environments": ({"num_envs": "two"}, "num_envs 'two'"),
    "true environments": ({"num_envs": True}, "num_envs True"),
    "a backend that is none": ({"sim_backend": "gpuu"}, "sim_backend 'gpuu': expected one of .*Did you mean"),
    "a number for a backend": ({"sim_backend": 3}, "sim_backend 3"),
    "noise that is no number": (
        {"pose_noise": float("nan")},
        "pose_noise nan: expected one or two finite numbers",
    ),
    "noise below zero": ({"pose_noise": -0.1}, "pose_noise -0.1"),
    "endless noise": ({"pose_noise": float("inf")}, "pose_noise inf"),
    "noise of three numbers": ({"pose_noise": (0.1, 0.1, 0.1)}, "pose_noise"),
    "a turn that is no number": ({"pose_noise": (0.1, float("nan"))}, "pose_noise"),
    "words for noise": ({"pose_noise": "much"}, "pose_noise 'much'"),
    "steps below zero": (
        {"max_episode_steps": -1},
        "max_episode_steps -1: expected a whole number, at least 1",
    ),
    "a render mode that is none": ({"render_mode": "film"}, "render_mode 'film': expected"),
    "a render backend that is none": ({"render_backend": "gpuu"}, "render_backend 'gpuu'"),
    "a task that is a number": ({"task": 3}, "task 3"),
    "a task that is none": ({"task": "juggle"}, "juggle"),
    "a target that is a list": ({"target": [1]}, r"target \[1\]"),
    "cameras that are a number": ({"cameras": 5}, "cameras 5"),
    "a camera that is none": ({"cameras": "moon"}, "moon"),
    "randomization that is no number": ({"randomize": {"shift_m": float("nan")}}, "shift_m"),
    "randomization below zero": ({"randomize": {"shift_m": -1}}, "shift_m"),
    "randomization of words": ({"randomize": {"shift_m": "x"}}, "shift_m"),
    "randomization of nothing known": ({"randomize": {"colour": 1}}, "colour"),
    "randomization that is a number": ({"randomize": 3}, "randomize"),
    "an observation mode that is a number": ({"obs_mode": 3}, "obs_mode 3"),
    "a reward mode that is none": ({"reward_mode": "much"}, "reward_mode 'much'"),
    "a control mode that is none": ({"control_mode": "mind"}, "mind"),
    "a robot that is none": ({"robot_uids": "r2d2"}, "r2d2"),
    "a task config that is none": ({"task_config": {"lift": 3}}, "task_config"),
    "an argument that is none": ({"num_env": 3}, "num_env.*Did you mean 'num_envs'"),
    "a revision that is a path": ({"revision": "../../x"}, "revision"),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_argument_is_named(name: str, scenes_root: Path) -> None:
    arguments, says = WRONG[name]
    simrecon_envs.register_scenes(scenes_root)
    started = time.perf_counter()
    with pytest.raises(SimReconError, match=says) as caught:
        gym.make("SimRecon/things", **arguments)
    assert time.perf_counter() - started < 10
    assert isinstance(caught.value, UsageError)
    assert len(str(caught.value).splitlines()) == 1


@pytest.mark.parametrize("steps", [0, -1, -5, 2.5, "many", True])
def test_a_wrong_length_of_episodes_is_named(steps: object, scenes_root: Path) -> None:
    with pytest.raises(UsageError, match=f"max_episode_steps {steps!r}: expected a whole number, at least 1"):
        simrecon_envs.make("things", registry=scenes_root, max_episode_steps=steps)


def test_lists_are_actions_and_wrong_ones_say_why(scenes_root: Path) -> None:
    env = simrecon_envs.make_cpu("things", registry=scenes_root)
    env.reset(seed=0)
    size = env.action_space.shape[0]
    observation, *_ = env.step([0.0] * size)
    env.reset(seed=0)
    other, *_ = env.step(np.zeros(size, np.float32))
    assert np.array_equal(observation, other)
    env.step(tuple([0] * size))
    for action in (
        [0.0],
        [0.0] * (size - 1) + [float("nan")],
        ["a"] * size,
        [[0.0], [0.0, 1.0]],
        "left",
        3,
        [None] * size,
    ):
        with pytest.raises(UsageError, match=r"action: expected .*(\(8,\)|finite)"):
            env.step(action)
    env.close()


def test_a_closed_environment_says_so(scenes_root: Path) -> None:
    env = simrecon_envs.make("things", registry=scenes_root)
    env.reset(seed=0)
    env.close()
    env.close()
    for call in (
        lambda: env.step(None),
        lambda: env.step(np.zeros(8)),
        lambda: env.reset(),
        lambda: env.reset(seed=1),
    ):
        with pytest.raises(
            UsageError, match=r"things: the environment is closed; make it again with gym\.make"
        ):
            call()
