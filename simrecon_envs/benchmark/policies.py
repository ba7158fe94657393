"""Policies by name: the built-in ones, and `module:callable` of anybody.

The callable is called with an environment (NumPy observations, not batched) and returns an object with `act`, and
perhaps `reset`, which is called after every reset of the environment. What it needs of the environment it says in
its attribute `policy_options`: keyword arguments of `gym.make`, or a function of the suite's task and of the policy's
own arguments that returns them.

    class Mine:
        policy_options = {"control_mode": "pd_ee_delta_pose", "obs_mode": "rgb"}
        def __init__(self, env): ...
        def reset(self): ...
        def act(self, observation): return action
"""

import hashlib
import os
import sys
import traceback
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, Protocol

import gymnasium as gym
import numpy as np

from registry import SimReconError, UsageError

if TYPE_CHECKING:
    from simrecon_envs.benchmark.suite import SuiteTask

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

    def make(self, env: gym.Env) -> Policy:
        """Return the policy for an environment; what it does wrong is said as one `UsageError`.

        Raises:
            UsageError: there is no such module or callable (names what there is), or it does not make a policy.
        """
        maker = self._maker()
        try:
            policy = maker(env, **self.arguments)
        except Exception as error:
            _fail(f"policy {self.name}: making it for {_where(env)}", error)
        if not callable(getattr(policy, "act", None)):
            raise UsageError(
                f"policy {self.name}: what it returned ({type(policy).__name__}) has no act(observation)"
            )
        return _Watched(policy, self.name, env)

    def options(self, task: "SuiteTask") -> dict[str, Any]:
        """Return the keyword arguments of `gym.make` that the policy wants for a task.

        Raises:
            UsageError: there is no such policy, or it wants to change what makes the episode.
        """
        wanted = getattr(self._maker(), "policy_options", {})
        if callable(wanted):
            try:
                wanted = wanted(task, **self.arguments)
            except Exception as error:
                _fail(f"policy {self.name}: its policy_options for {task.name}", error)
        wrong = sorted(set(wanted) & set(FIXED))
        if wrong:
            raise UsageError(
                f"policy {self.name}: its policy_options has {', '.join(wrong)}, which the suite decides; a policy "
                "may ask for obs_mode, control_mode, reward_mode, cameras, sensor_configs and the like"
            )
        return dict(wanted)

    def digest(self) -> str:
        """Return a digest of its module's file and of files and folders that its arguments name.

        A run that goes on tells by it whether the policy is still the one that it was begun with.
        """
        digest = hashlib.sha256()
        if self.name not in BUILT_IN:
            self._maker()  # its module is found from here on
            file = import_module(self.name.partition(":")[0]).__file__
            digest.update(Path(file).read_bytes() if file else b"")
        for value in self.arguments.values():
            path = Path(value).expanduser()
            files = sorted(path.rglob("*")) if path.is_dir() else [path]
            for file in files:
                if file.is_file():
                    known = file.stat()
                    digest.update(f"{file}\0{known.st_size}\0{known.st_mtime_ns}\0".encode())
        return digest.hexdigest()[:16]

    def _maker(self) -> Callable:
        return BUILT_IN.get(self.name) or _find(self.name)


class _Watched:
    """A policy whose errors and actions that cannot be are said with policy, task and step."""

    def __init__(self, policy: Policy, name: str, env: gym.Env) -> None:
        self._policy, self._name, self._env = policy, name, env
        self._step = 0

    def reset(self) -> None:
        """Begin an episode."""
        self._step = 0
        if hasattr(self._policy, "reset"):
            try:
                self._policy.reset()
            except Exception as error:
                _fail(f"policy {self._name}: reset() in {_where(self._env)}", error)

    def act(self, observation: Any) -> np.ndarray:
        """Return the policy's action, float32 (k,)."""
        self._step += 1
        try:
            answer = self._policy.act(observation)
        except Exception as error:
            _fail(
                f"policy {self._name}: act() at step {self._step} of an episode of {_where(self._env)}", error
            )
        shape = self._env.action_space.shape
        try:
            if answer is None:
                raise TypeError
            action = np.asarray(answer.detach().cpu() if hasattr(answer, "detach") else answer, np.float32)
            wrong = "" if action.shape == shape else f"an action of shape {action.shape}"
        except (TypeError, ValueError):
            wrong = f"what is no array of numbers ({type(answer).__name__})"
        if not wrong and not np.isfinite(action).all():
            wrong = f"an action that is not finite ({np.array2string(action, precision=3, threshold=8)})"
        if wrong:
            raise UsageError(
                f"policy {self._name}: act() returned {wrong} at step {self._step} of an episode of "
                f"{_where(self._env)}; expected {shape[0]} finite numbers, an array of shape {shape}"
            )
        return action


def _fail(what: str, error: Exception) -> NoReturn:
    """Raise a policy's error as one that says where in whose code; the project's own ones go on as they are."""
    if isinstance(error, SimReconError):
        raise error
    last = traceback.extract_tb(error.__traceback__)[-1]
    theirs = os.path.isfile(last.filename) and last.filename != __file__
    at = f" ({last.filename}:{last.lineno})" if theirs else ""
    raise UsageError(
        f"{what} raised {type(error).__name__}: {error}{at}. SIMRECON_DEBUG=1 shows the whole traceback"
    ) from error


def _where(env: gym.Env) -> str:
    scene = env.unwrapped
    return f"{scene.scene_id}, {scene.task}, {scene.robot_uids}"


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
    except Exception as error:
        _fail(f"policy {name}: importing {module_name}", error)
    for part in attribute.split("."):
        found = getattr(found, part, None)
    if not callable(found):
        raise UsageError(f"policy {name}: {module_name} has no callable {attribute!r}")
    return found
