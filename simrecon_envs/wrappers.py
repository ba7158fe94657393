"""Environment wrappers whose specs, unlike ManiSkill's, can be serialized to JSON."""

import copy
from typing import Any, cast

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils import RecordConstructorArgs
from mani_skill.utils.wrappers.gymnasium import CPUGymWrapper

from registry import UsageError
from simrecon_envs.stepping import as_action
from simrecon_envs.unwrapped import scene_of


class BatchedTimeLimit(gym.Wrapper, RecordConstructorArgs):
    """Time limit with `truncated` per environment; replaces Gymnasium's `TimeLimit`, whose `truncated` is one bool.

    The limit is that of `gym.make`: the registered one or its argument `max_episode_steps`. Equivalent to ManiSkill's
    `TimeLimitWrapper`, which reads the local variables of its caller.
    """

    def __init__(self, env: gym.Env) -> None:
        """Wrap an environment from `gym.make`.

        Raises:
            UsageError: It has no `TimeLimit`, as with `max_episode_steps=-1`.
        """
        RecordConstructorArgs.__init__(self)
        if not isinstance(env, gym.wrappers.TimeLimit):
            env.close()
            raise UsageError(
                "max_episode_steps -1: expected a whole number, at least 1; a large one, such as 10**9, is no limit"
            )
        self._max_episode_steps: int = env._max_episode_steps
        env = env.env
        gym.Wrapper.__init__(self, env)
        self._base = scene_of(env)

    @property
    def spec(self) -> EnvSpec | None:
        """Return the spec with the limit of this wrapper."""
        spec = super().spec
        if spec is not None and spec.max_episode_steps != self._max_episode_steps:
            spec = copy.deepcopy(spec)
            spec.max_episode_steps = self._max_episode_steps
        return spec

    def step(self, action: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step; `truncated` (num_envs,) is set in environments that reached the limit."""
        obs, reward, terminated, truncated, info = self.env.step(action)
        limit, base = self._max_episode_steps, self._base
        # For one environment, avoid tensors until the limit is reached: they cost more than the rest.
        if base.num_envs > 1 or base.steps_done() >= limit:
            truncated = truncated | (base.elapsed_steps >= limit)
        return obs, reward, terminated, truncated, info


class NumpyEnv(CPUGymWrapper, RecordConstructorArgs):
    """ManiSkill's `CPUGymWrapper` with the types that Gymnasium's checker and most libraries expect.

    Observations are unbatched NumPy arrays, rewards `float`, `terminated` and `truncated` `bool`. The info of `reset`
    has the task's texts.
    """

    def __init__(self, env: gym.Env, ignore_terminations: bool = False, record_metrics: bool = False) -> None:
        """Wrap one environment on the CPU; options as in `CPUGymWrapper`."""
        RecordConstructorArgs.__init__(
            self, ignore_terminations=ignore_terminations, record_metrics=record_metrics
        )
        CPUGymWrapper.__init__(self, env, ignore_terminations, record_metrics)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict]:
        """Step with an unbatched NumPy action, or a list of numbers."""
        if not isinstance(action, np.ndarray):
            action = as_action(scene_of(self), action)
        obs, reward, terminated, truncated, info = super().step(action)
        return obs, float(np.asarray(reward)), bool(terminated), bool(truncated), cast("dict[str, Any]", info)

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[Any, dict]:
        """Reset; `info` also has "instruction" and "task_note"."""
        obs, info = super().reset(seed=seed, options=options)
        base = scene_of(self)
        return obs, {
            **cast("dict[str, Any]", info),
            "instruction": base.instruction,
            "task_note": base.task_note,
        }
