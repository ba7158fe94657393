"""Control step of one environment on the CPU: action -> physics -> observation, reward, info.

Equivalent to ManiSkill's step, but computed in NumPy and converted to tensors at the end: right after the physics, with
cold caches, a torch operation takes tens of microseconds.
"""

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from mani_skill.agents.base_agent import BaseAgent
from mani_skill.envs.sapien_env import BaseEnv

from registry import UsageError
from simrecon_envs.cpu_env import DirectDrive

_HOOKS = ("_before_control_step", "_after_control_step", "_before_simulation_step", "_after_simulation_step")


class DirectStep:
    """Control steps of a built `SceneEnv`; replace it when `current` is false."""

    def __init__(self, env: Any) -> None:
        """Read the current controller and simulation of the environment."""
        self._env = env
        self._scene, agent = env.scene, env.agent
        self._controller = None if agent is None else agent.controller
        self._drive = None if agent is None else DirectDrive(agent)
        self._hooked = any(getattr(type(env), name) is not getattr(BaseEnv, name) for name in _HOOKS)
        # Whether the observation can be concatenated directly, without a dict of tensors.
        plain = agent is not None and type(agent).get_proprioception is BaseAgent.get_proprioception
        self._flat = env.obs_mode == "state" and plain and not env.agent.controller.get_state()
        self._robot = None if agent is None else agent.robot._objs[0]
        # Reused in every step: filling a tensor is faster than creating one.
        self._action = torch.zeros((1, *(() if agent is None else agent.single_action_space.shape)))
        self._numbers = self._action.numpy()[0]
        self._shapes = (self._numbers.shape, tuple(self._action.shape))
        self._laid_out = False
        self._elapsed = env._elapsed_steps
        self._count = self._elapsed.numpy()

    @property
    def current(self) -> bool:
        """Return whether the environment still has the controller and simulation that this was created for."""
        env = self._env
        agent = env.agent
        controller = None if agent is None else agent.controller
        return (
            self._scene is env.scene
            and self._controller is controller
            and self._elapsed is env._elapsed_steps
        )

    @property
    def steps(self) -> int:
        """Return the number of steps in this episode."""
        return self._count.item()

    def simulate(self, action: np.ndarray | torch.Tensor) -> torch.Tensor:
        """Simulate one control step.

        Args:
            action: (k,) or (1, k).

        Returns:
            The action (1, k), valid until the next step.

        Raises:
            UsageError: See `check_action`.
        """
        env, drive, batched = self._env, self._drive, self._action
        if drive is None or action.shape not in self._shapes:
            check_action(env, action)
        assert drive is not None  # checked above
        self._numbers[:] = action if isinstance(action, np.ndarray) else action.numpy(force=True)
        listed = self._numbers.tolist()
        if not math.isfinite(sum(listed)):
            check_action(env, action)
        drive.set_action(batched, self._numbers, listed)
        if drive.idle and not self._hooked:
            step = env.scene.px.step
            for _ in range(env._sim_steps_per_control):
                step()
            return batched
        env._before_control_step()
        for _ in range(env._sim_steps_per_control):
            if not drive.idle:
                env.agent.before_simulation_step()
            env._before_simulation_step()
            env.scene.step()
            env._after_simulation_step()
        env._after_control_step()
        return batched

    def outcome(self, action: torch.Tensor | None) -> tuple:
        """Return (observation, reward, terminated, truncated, info) after the simulation."""
        env = self._env
        self._count[0] = self._count.item() + 1  # in place; faster than NumPy's "+="
        info = env.get_info()
        flat = self._observe() if self._flat else None
        obs = env.get_obs(info, unflattened=True) if flat is None else flat
        reward = env.get_reward(obs=obs, action=action, info=info)
        env._last_obs = obs = env._flatten_raw_obs(obs) if flat is None else flat
        ended = bool(env._info.get("success", False)) or bool(env._info.get("fail", False))
        return obs, reward, torch.from_numpy(np.array([ended])), torch.from_numpy(np.array([False])), info

    def _observe(self) -> torch.Tensor | None:
        """Return the observation "state" (1, n); None if the task observes an array that is not 2D."""
        known = list(self._env.known().values())
        if not self._laid_out:
            if any(part.ndim != 2 for part in known):
                self._flat = False
                return None
            self._laid_out = True
        robot: Any = self._robot
        rows = [robot.qpos, robot.qvel, *[part[0] for part in known]]
        return torch.from_numpy(np.concatenate(rows, dtype=np.float32)[None])


def as_action(env: Any, action: Any) -> Any:
    """Return an action as an array if it is a list or tuple of numbers; arrays, tensors, dicts and None as they are.

    Raises:
        UsageError: It is something else.
    """
    if action is None or isinstance(action, np.ndarray | torch.Tensor | dict):
        if isinstance(action, np.ndarray) and action.dtype.kind not in "fiub":
            raise UsageError(f"action: expected numbers{_shape_of(env)}, got an array of {action.dtype}")
        return action
    try:
        if not isinstance(action, list | tuple):
            raise TypeError
        return np.asarray(action, np.float32)
    except (TypeError, ValueError, OverflowError):
        raise UsageError(
            f"action: expected an array of numbers{_shape_of(env)}, got {str(action)[:60]!r}"
        ) from None


def _shape_of(env: Any) -> str:
    return "" if env.agent is None else f" of the shape {env._orig_single_action_space.shape}"


def check_action(env: Any, action: np.ndarray | torch.Tensor) -> None:
    """Check an action for the robot of a `SceneEnv`.

    Raises:
        UsageError: There is no robot, the action does not have the shape of the action space, or it is not finite.
    """
    if env.agent is None:
        raise UsageError("this environment has no robot: step(None)")
    single, shape = env._orig_single_action_space.shape, action.shape
    if shape != (env.num_envs, *single) and not (env.num_envs == 1 and shape == single):
        raise UsageError(f"action: expected the shape {(env.num_envs, *single)} or, of one environment, "
                         f"{single}; got {tuple(shape)}")  # fmt: skip
    if isinstance(action, np.ndarray):
        finite = all(map(math.isfinite, action.ravel().tolist()))
    else:
        finite = env.gpu_sim_enabled or torch.isfinite(action).all()
    if not finite:
        raise UsageError("action: expected finite numbers, got NaN or infinity")


def flatten(obs: dict) -> torch.Tensor | None:
    """Concatenate an observation of CPU tensors (1, k) to (1, n); return None if it has another tensor."""
    leaves = list(_leaves(obs))
    if not leaves or any(leaf.ndim != 2 for leaf in leaves):
        return None
    return torch.from_numpy(np.concatenate([leaf.numpy() for leaf in leaves], axis=1, dtype=np.float32))


def _leaves(obs: dict) -> Iterator[torch.Tensor]:
    for value in obs.values():
        if isinstance(value, dict):
            yield from _leaves(value)
        else:
            yield value
