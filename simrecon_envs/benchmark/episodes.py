"""One episode: reset, ask the policy until the environment ends, measure."""

import hashlib
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np

from simrecon_envs.arrays import numpy
from simrecon_envs.benchmark.policies import Policy


@dataclass(frozen=True, kw_only=True)
class Episode:
    """What happened."""

    seed: int
    success: bool
    at_reset: bool  # it was done before the first action
    steps: int
    path_m: float  # way of the hand's tip, of the base where the task is about driving
    reward: float  # sum
    act_s: float  # wall time that the policy took
    start: str  # digest of the first observation


def run_episode(
    env: gym.Env, policy: Policy, seed: int, on_step: Callable[[Any, Any, tuple | None], None] | None = None
) -> Episode:
    """Run an episode to its end: success, or the horizon.

    Args:
        env: A plain Gymnasium environment around a `SceneEnv` with a limit of steps.
        policy: Acts; its `reset` is called after the environment's.
        seed: Of the reset.
        on_step: Called with (observation, None, None) after the reset, then with each action's (observation before,
            action, what `step` returned).
    """
    scene = env.unwrapped
    obs, _ = env.reset(seed=seed)
    start = _digest(obs)
    if hasattr(policy, "reset"):
        policy.reset()
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
    """Return where what does the task is (3,), world, metres."""
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
