"""Wrappers whose specs can be written as JSON and made again, which ManiSkill's own cannot."""

import copy
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils import RecordConstructorArgs
from mani_skill.utils.wrappers.gymnasium import CPUGymWrapper


class BatchedTimeLimit(gym.Wrapper, RecordConstructorArgs):
    """Takes the place of Gymnasium's `TimeLimit`, whose `truncated` is one bool, not one an environment.

    The limit is the one that `gym.make` wrapped with: the registered one, or its argument
    `max_episode_steps`. Does what ManiSkill's `TimeLimitWrapper` does, but that looks into its caller's local
    variables.
    """

    def __init__(self, env: gym.Env) -> None:
        """Wrap what `gym.make` made; without a `TimeLimit` there is no limit."""
        RecordConstructorArgs.__init__(self)
        self._max_episode_steps: int | None = None
        if isinstance(env, gym.wrappers.TimeLimit):
            self._max_episode_steps = env._max_episode_steps
            env = env.env
        gym.Wrapper.__init__(self, env)
        self._base = env.unwrapped

    @property
    def spec(self) -> EnvSpec | None:
        """Return the spec with the limit that holds here."""
        spec = gym.Wrapper.spec.fget(self)
        if spec is not None and spec.max_episode_steps != self._max_episode_steps:
            spec = copy.deepcopy(spec)
            spec.max_episode_steps = self._max_episode_steps
        return spec

    def step(self, action: Any) -> tuple[Any, torch.Tensor, torch.Tensor, torch.Tensor, dict]:
        """Step; `truncated` (num_envs,) is set where the limit is reached."""
        obs, reward, terminated, truncated, info = self.env.step(action)
        limit, base = self._max_episode_steps, self._base
        # Of one environment no tensor is made unless it must: that takes longer than the rest of it.
        if limit is not None and (base.num_envs > 1 or base.steps_done() >= limit):
            truncated = truncated | (base.elapsed_steps >= limit)
        return obs, reward, terminated, truncated, info


class NumpyEnv(CPUGymWrapper, RecordConstructorArgs):
    """ManiSkill's `CPUGymWrapper`, with the types that Gymnasium's checker and most libraries expect.

    Observations are unbatched NumPy arrays, rewards `float`, `terminated` and `truncated` `bool`; the texts
    of the task are in the info of `reset`.
    """

    def __init__(self, env: gym.Env, ignore_terminations: bool = False, record_metrics: bool = False) -> None:
        """Wrap one environment on the CPU; the options are those of `CPUGymWrapper`."""
        RecordConstructorArgs.__init__(
            self, ignore_terminations=ignore_terminations, record_metrics=record_metrics
        )
        CPUGymWrapper.__init__(self, env, ignore_terminations, record_metrics)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict]:
        """Step with an unbatched NumPy action."""
        obs, reward, terminated, truncated, info = super().step(action)
        return obs, float(np.asarray(reward)), bool(terminated), bool(truncated), info

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[Any, dict]:
        """Reset; `info` also has "instruction" and "task_note"."""
        obs, info = super().reset(seed=seed, options=options)
        scene_env = self.unwrapped
        return obs, {**info, "instruction": scene_env.instruction, "task_note": scene_env.task_note}
