"""Evaluate a policy on fixed seeds that training does not use, and record a video."""

from collections.abc import Callable
from pathlib import Path
from statistics import mean, median
from typing import Any

import numpy as np

from registry import EnvironmentMissing
from simrecon_envs.benchmark.episodes import run_episode
from simrecon_envs.benchmark.policies import Policy
from simrecon_envs.benchmark.statistics import wilson
from simrecon_envs.rollout import open_video
from simrecon_envs.training.config import LARGEST_SEED, TrainConfig
from simrecon_envs.training.environments import make_plain
from simrecon_envs.unwrapped import scene_of

FIRST_SEED = LARGEST_SEED + 1
VIDEO_EPISODES = 4
_VIDEO_PX = 384
_LAST_FRAMES = 8  # repetitions of an episode's last frame


def evaluate(
    config: TrainConfig,
    policy: Policy,
    episodes: int,
    on_episode: Callable[[int, int], None] = lambda done, successes: None,
) -> dict[str, Any]:
    """Run a policy for episodes with the seeds FIRST_SEED, FIRST_SEED + 1, and so on.

    Args:
        config: Of the run.
        policy: The policy.
        episodes: Number of episodes, at least one.
        on_episode: Called after every episode with the numbers of episodes and of successes so far.

    Returns:
        {"episodes", "successes", "success_rate", "wilson_95": [low, high], "return_mean", "steps_mean",
        "steps_to_success_median" (None without success), "seeds": [first, last], "per_episode": [{"seed",
        "success", "return", "steps"}]}; steps are 1/20 s, returns are undiscounted
        and without bonus.
    """
    env = make_plain(config)
    rows: list[dict[str, Any]] = []
    try:
        for seed in range(FIRST_SEED, FIRST_SEED + episodes):
            found = run_episode(env, policy, seed)
            rows.append(
                {"seed": seed, "success": found.success, "return": found.reward, "steps": found.steps}
            )
            on_episode(len(rows), sum(row["success"] for row in rows))
    finally:
        env.close()
    successes = sum(row["success"] for row in rows)
    fast = [row["steps"] for row in rows if row["success"]]
    return {
        "episodes": episodes,
        "successes": successes,
        "success_rate": successes / episodes,
        "wilson_95": list(wilson(successes, episodes)),
        "return_mean": mean(row["return"] for row in rows),
        "steps_mean": mean(row["steps"] for row in rows),
        "steps_to_success_median": median(fast) if fast else None,
        "seeds": [rows[0]["seed"], rows[-1]["seed"]],
        "per_episode": rows,
    }


def record(config: TrainConfig, policy: Policy, path: Path, episodes: int = VIDEO_EPISODES) -> str:
    """Record the first episodes of the evaluation as a video.

    Returns:
        An empty text, or the reason why there is no video: nothing can render here.
    """
    size = {"width": _VIDEO_PX, "height": _VIDEO_PX}
    try:
        env = make_plain(config, render_mode="rgb_array", human_render_camera_configs=size)
    except EnvironmentMissing as error:
        return str(error)
    try:
        with open_video(path, scene_of(env).control_freq) as add:
            for seed in range(FIRST_SEED, FIRST_SEED + episodes):
                run_episode(env, policy, seed, lambda *_: add(np.asarray(env.render())))
                for _ in range(_LAST_FRAMES):
                    add(np.asarray(env.render()))
    finally:
        env.close()
    return ""
