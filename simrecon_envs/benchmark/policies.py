"""Policies by name: the built-in ones, and `module:callable` of anybody.

The callable is called with an environment (NumPy observations, not batched) and returns an object with `act`, and
perhaps `reset`, which is called after every reset of the environment. What it needs of the environment it says in
its attribute `policy_options`, keyword arguments of `gym.make`:

    class Mine:
        policy_options = {"control_mode": "pd_ee_delta_pose", "obs_mode": "rgb"}
        def __init__(self, env): ...
        def reset(self): ...
        def act(self, observation): return action
"""

import os
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any, Protocol

import gymnasium as gym
import numpy as np

from registry import UsageError

CONTROL_MODE = "pd_ee_delta_pose"  # the oracle's
# What makes an episode what it is; a policy may choose the others.
FIXED = ("task", "target", "robot_uids", "randomize", "pose_noise", "max_episode_steps", "reconfiguration_freq",
         "num_envs", "scene_id", "revision", "registry", "task_config", "render_mode")  # fmt: skip


class Policy(Protocol):
    """What `benchmark run` needs; `reset()` may be absent."""

    def act(self, observation: Any) -> np.ndarray:
        """Return the action for an observation."""


class OraclePolicy:
    """The script that the suite was proven with. It sees the simulation, not the observations."""

    policy_options = {"control_mode": CONTROL_MODE}  # noqa: RUF012 - read only, as in the protocol

    def __init__(self, env: gym.Env) -> None:
        self._env = env

    def reset(self) -> None:
        """Start the script again."""
        from simrecon_envs.oracle import Oracle

        self._oracle = Oracle(self._env)

    def act(self, observation: Any) -> np.ndarray:
        """Return the script's next action."""
        return self._oracle.action()


class StillPolicy:
    """Does nothing: every action is zero."""

    def __init__(self, env: gym.Env) -> None:
        self._action = np.zeros(env.action_space.shape, np.float32)

    def act(self, observation: Any) -> np.ndarray:
        """Return zeros."""
        return self._action


class RandomPolicy:
    """Draws actions uniformly, the same ones for the same episode."""

    def __init__(self, env: gym.Env) -> None:
        self._env = env

    def reset(self) -> None:
        """Seed the actions by the episode's seed."""
        self._env.action_space.seed(int(self._env.unwrapped._episode_seed[0]))

    def act(self, observation: Any) -> np.ndarray:
        """Return a random action."""
        return self._env.action_space.sample()


BUILT_IN: dict[str, Callable] = {"oracle": OraclePolicy, "still": StillPolicy, "random": RandomPolicy}


@dataclass(frozen=True)
class PolicySpec:
    """A policy by its name and arguments; loaded in each process."""

    name: str
    arguments: dict[str, str] = field(default_factory=dict)

    def load(self) -> Callable[[gym.Env], Policy]:
        """Return what makes the policy for an environment.

        Raises:
            UsageError: there is no such module or callable; names what there is.
        """
        maker = BUILT_IN.get(self.name) or _find(self.name)
        return lambda env: _checked(maker(env, **self.arguments), self.name)

    def options(self) -> dict[str, Any]:
        """Return the keyword arguments of `gym.make` that the policy wants.

        Raises:
            UsageError: it wants to change what makes the episode.
        """
        maker = BUILT_IN.get(self.name) or _find(self.name)
        options = dict(getattr(maker, "policy_options", {}))
        wrong = sorted(set(options) & set(FIXED))
        if wrong:
            raise UsageError(
                f"policy {self.name}: its policy_options has {', '.join(wrong)}, which the suite decides; a policy "
                "may ask for obs_mode, control_mode, reward_mode, cameras, sensor_configs and the like"
            )
        return options


def _find(name: str) -> Callable:
    module_name, _, attribute = name.partition(":")
    if not module_name or not attribute:
        raise UsageError(
            f"policy {name!r}: expected {', '.join(BUILT_IN)} or module:callable, such as my_policy:Policy"
        )
    here = os.getcwd()
    if here not in sys.path:  # as `python -m` does; a console script does not
        sys.path.insert(0, here)
    try:
        found: Any = import_module(module_name)
    except ModuleNotFoundError as error:
        if error.name is None or (module_name != error.name and not module_name.startswith(error.name + ".")):
            raise UsageError(f"policy {name}: importing {module_name} needs the module {error.name!r}, which is "
                             "not installed") from error  # fmt: skip
        raise UsageError(
            f"policy {name}: there is no module {module_name!r} here or installed; run from the folder it is in"
        ) from error
    for part in attribute.split("."):
        found = getattr(found, part, None)
    if not callable(found):
        raise UsageError(f"policy {name}: {module_name} has no callable {attribute!r}")
    return found


def _checked(policy: Any, name: str) -> Policy:
    if not callable(getattr(policy, "act", None)):
        raise UsageError(f"policy {name}: what it returned ({type(policy).__name__}) has no act(observation)")
    return policy
