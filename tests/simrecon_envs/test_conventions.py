"""Every task, robot and observation mode: the checkers of Gymnasium and stable-baselines3, and ManiSkill's rules."""

import os
from pathlib import Path

import gymnasium as gym
import numpy as np
import psutil
import pytest
import torch

import simrecon_envs
from benchmarks.conventions import check_case

TASKS = ("reach", "pick", "place", "put", "stack", "push", "rearrange", "none")
STATE_MODES, PICTURE_MODES = ("state", "state_dict"), ("rgb", "rgbd", "segmentation", "pointcloud")
SMALL = {"sensor_configs": {"width": 32, "height": 32}}
SCENES = {"things": TASKS, "room": ("reach", "pick", "place", "push", "none")}  # `room` has no container

FAST = [
    ("things", "put", "panda", "state"),
    ("room", "pick", "fetch", "state_dict"),
    ("things", "none", "panda", "state"),
]
MATRIX = [
    (scene, task, robot, mode)
    for scene, tasks in SCENES.items()
    for robot in ("panda", "fetch")
    for task in (*tasks, *(("navigate",) if robot == "fetch" else ()))
    for mode in (*STATE_MODES, *PICTURE_MODES)
]
# Images do not depend on the task: by default, test one scene and task per robot and image mode. The whole matrix takes
# an hour without a GPU.
WHOLE = os.environ.get("SIMRECON_TEST_WHOLE_MATRIX") == "1"
DRAWN = {
    (scene, tasks[(number + step) % len(tasks)], robot, mode)
    for number, robot in enumerate(("panda", "fetch"))
    for step, mode in enumerate(PICTURE_MODES)
    for scene, tasks in [list(SCENES.items())[(number + step) % len(SCENES)]]
}


def _parameters() -> list:
    fast = [pytest.param(*case, id="-".join(case)) for case in FAST]
    slow = []
    for case in MATRIX:
        if case[3] in PICTURE_MODES and case not in DRAWN and not WHOLE:
            continue
        marks = [pytest.mark.end_to_end, *([pytest.mark.render] if case[3] in PICTURE_MODES else [])]
        slow.append(pytest.param(*case, marks=marks, id="-".join(case)))
    return fast + [case for case in slow if case.values not in FAST]


def _kwargs(task: str, mode: str) -> dict:
    return {"task": task, "obs_mode": mode, **(SMALL if mode in PICTURE_MODES else {})}


@pytest.mark.parametrize(("scene", "task", "robot", "mode"), _parameters())
def test_checkers_pass(scene: str, task: str, robot: str, mode: str, scenes_root: Path) -> None:
    env = simrecon_envs.make_cpu(scene, registry=scenes_root, robot_uids=robot, **_kwargs(task, mode))
    check_case(env)
    env.close()


def _run_at_the_bounds(env: gym.Env, steps: int) -> None:
    low, high = env.action_space.low, env.action_space.high
    rng = np.random.default_rng(0)
    for step in range(steps):
        obs, reward, _, _, _ = env.step(np.where(rng.random(low.shape) < 0.5, low, high))
        assert torch.isfinite(obs).all(), f"step {step}"
        assert 0 <= float(reward) <= 1
        if step % 200 == 199:
            env.reset()


@pytest.mark.parametrize("steps", [300, pytest.param(10_000, marks=pytest.mark.end_to_end)])
def test_actions_at_the_bounds_give_finite_numbers(steps: int, scenes_root: Path) -> None:
    env = simrecon_envs.make(
        "things", registry=scenes_root, task="rearrange", randomize="all", max_episode_steps=10**9
    )
    env.reset(seed=0)
    _run_at_the_bounds(env, steps)
    env.close()


@pytest.mark.parametrize("resets", [60, pytest.param(500, marks=pytest.mark.end_to_end)])
def test_memory_does_not_grow_with_resets(resets: int, scenes_root: Path) -> None:
    env = simrecon_envs.make("things", registry=scenes_root, task="rearrange", randomize="all")
    process = psutil.Process()
    for number in range(40):
        env.reset(seed=number)
    before = process.memory_info().rss
    for number in range(resets):
        env.reset(seed=number)
        env.step(env.action_space.sample())
    assert process.memory_info().rss - before < 3e6
    env.close()
