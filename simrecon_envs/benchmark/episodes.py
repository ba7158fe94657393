"""Run one episode of a policy in an environment, and measure it."""

import hashlib
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np

from simrecon_envs.arrays import numpy
from simrecon_envs.benchmark.policies import Policy, begin_episode
from simrecon_envs.unwrapped import scene_of


@dataclass(frozen=True, kw_only=True)
class Episode:
    """Measurements of an episode."""

    seed: int
    success: bool
    at_reset: bool  # success before the first action
    steps: int
    path_m: float  # path length of the hand; of the base in navigation tasks
    reward: float  # undiscounted return
    act_s: float  # wall time of the policy
    start: str  # digest of the first observation


def run_episode(
    env: gym.Env, policy: Policy, seed: int, on_step: Callable[[Any, Any, tuple | None], None] | None = None
) -> Episode:
    """Run an episode until success or the step limit.

    Args:
        env: A `SceneEnv` wrapped to NumPy, with a step limit.
        policy: Its `reset`, if any, is called after the environment's.
        seed: For the environment's reset.
        on_step: Called after the reset with (observation, None, None), then after each step with (observation before,
            action, result of `step`).
    """
    scene = scene_of(env)
    obs, _ = env.reset(seed=seed)
    start = _digest(obs)
    begin_episode(policy)
    if on_step is not None:
        on_step(obs, None, None)
    at_reset = bool(numpy(scene.evaluate()["success"])[0])
    where, path, total, act_s, steps = _place(scene), 0.0, 0.0, 0.0, 0
    success, ended = at_reset, False
    while not ended:
        began = time.perf_counter()
        action = policy.act(obs)
        act_s += time.perf_counter() - began
        result = env.step(action)
        if on_step is not None:
            on_step(obs, action, result)
        obs, reward, terminated, truncated, info = result
        here = _place(scene)
        path += float(np.linalg.norm(here - where))
        where, total, steps = here, total + float(reward), steps + 1
        success = bool(np.ravel(info["success"])[0])
        ended = bool(terminated) or bool(truncated)
    return Episode(seed=seed, success=success, at_reset=at_reset, steps=steps, path_m=path, reward=total,
                   act_s=act_s, start=start)  # fmt: skip


def _place(scene: Any) -> np.ndarray:
    """Return the position (3,) of the hand, or of the base in navigation tasks; world, metres."""
    if scene.task_object.mobile_only:
        return numpy(scene.agent.base_link.pose.p)[0].astype(np.float64)
    return numpy(scene.measures.tcp)[0, :3].astype(np.float64)


def _digest(obs: Any) -> str:
    digest = hashlib.sha256()
    for leaf in _leaves(obs):
        digest.update(np.ascontiguousarray(leaf).tobytes())
    return digest.hexdigest()[:16]


def _leaves(obs: Any) -> list[np.ndarray]:
    if isinstance(obs, dict):
        return [leaf for key in sorted(obs) for leaf in _leaves(obs[key])]
    return [numpy(obs) if not isinstance(obs, np.ndarray) else obs]
