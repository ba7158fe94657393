"""Load policies by name: built-in ones, or `module:callable`.

The callable takes an environment (NumPy observations, not batched) and returns an object with `act` and, optionally,
`reset`, which is called after every reset of the environment. Its attribute `policy_options` holds arguments of
`gym.make`, or is a function that returns them, given the suite's task and the policy's own arguments.

    class Mine:
        policy_options = {"control_mode": "pd_ee_delta_pose", "obs_mode": "rgb"}
        def __init__(self, env): ...
        def reset(self): ...
        def act(self, observation): return action
"""

import hashlib
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, NoReturn, Protocol

import gymnasium as gym
import numpy as np

from registry import SimReconError, UsageError
from simrecon_envs.unwrapped import scene_of

if TYPE_CHECKING:
    from simrecon_envs.benchmark.suite import SuiteTask

CONTROL_MODE = "pd_ee_delta_pose"  # the oracle's
# Arguments of `gym.make` that define an episode; a policy may set the others.
FIXED = ("task", "target", "robot_uids", "randomize", "pose_noise", "max_episode_steps", "reconfiguration_freq",
         "num_envs", "scene_id", "revision", "registry", "task_config", "render_mode")  # fmt: skip


class PolicyTimeout(BaseException):
    """A policy took too long. Not an `Exception`, so that a policy's own `except Exception` does not swallow it."""


_ENDINGS = (Exception, SystemExit, GeneratorExit, PolicyTimeout)  # of a policy's code; Ctrl-C goes through


class Policy(Protocol):
    """Interface of `benchmark run`; `reset()` is optional."""

    def act(self, observation: Any) -> np.ndarray:
        """Return the action for an observation."""
        ...


def begin_episode(policy: Policy) -> None:
    """Call the policy's `reset`, if it has one."""
    if (reset := getattr(policy, "reset", None)) is not None:
        reset()


@dataclass
class OraclePolicy:
    """The scripted policy of `simrecon_envs.oracle`; it reads the simulator's state, not the observations."""

    env: gym.Env
    policy_options: ClassVar = {"control_mode": CONTROL_MODE}

    def reset(self) -> None:
        """Restart the script."""
        from simrecon_envs.oracle import Oracle

        self._oracle = Oracle(self.env)

    def act(self, observation: Any) -> np.ndarray:
        """Return the script's next action."""
        return self._oracle.action()


class StillPolicy:
    """All actions are zero."""

    def __init__(self, env: gym.Env) -> None:
        """Act in an environment."""
        self._action = np.zeros(action_shape(env), np.float32)

    def act(self, observation: Any) -> np.ndarray:
        """Return zeros."""
        return self._action


@dataclass
class RandomPolicy:
    """Uniformly random actions, determined by the episode's seed."""

    env: gym.Env

    def reset(self) -> None:
        """Seed the action space with the episode's seed."""
        self.env.action_space.seed(int(scene_of(self.env)._episode_seed[0]))

    def act(self, observation: Any) -> np.ndarray:
        """Return a random action."""
        return self.env.action_space.sample()


def action_shape(env: gym.Env) -> tuple[int, ...]:
    """Return the shape of an environment's actions."""
    assert env.action_space.shape is not None
    return env.action_space.shape


BUILT_IN: dict[str, Callable] = {"oracle": OraclePolicy, "still": StillPolicy, "random": RandomPolicy}


@dataclass(frozen=True)
class PolicySpec:
    """Name and arguments of a policy; every process loads it."""

    name: str
    arguments: dict[str, str] = field(default_factory=dict)

    def make(self, env: gym.Env, timeout_s: float | None = None) -> Policy:
        """Make the policy for an environment; its exceptions, exits and invalid actions become a `UsageError`.

        Args:
            env: The environment to act in.
            timeout_s: Longest time of one call of the policy, of its making too; None: no limit. Only Python code in
                the main thread can be interrupted.

        Raises:
            UsageError: there is no such module or callable, it does not return a policy, or it takes too long.
        """
        maker = self._maker()
        try:
            with time_limit(timeout_s):
                policy = maker(env, **self.arguments)
        except _ENDINGS as error:
            _fail(f"policy {self.name}: making it for {_where(env)}", error)
        if not callable(getattr(policy, "act", None)):
            raise UsageError(
                f"policy {self.name}: the returned {type(policy).__name__} has no act(observation)"
            )
        return _Watched(policy, self.name, env, timeout_s)

    def warnings(self) -> list[str]:
        """Return what its user should know before it is made: the result of the callable's `policy_warning`, if any.

        Raises:
            UsageError: there is no such policy.
        """
        said = getattr(self._maker(), "policy_warning", None)
        try:
            return [str(said(**self.arguments))] if callable(said) else []
        except _ENDINGS as error:
            _fail(f"policy {self.name}: its policy_warning", error)

    def options(self, task: "SuiteTask") -> dict[str, Any]:
        """Return the policy's keyword arguments for `gym.make` for a task.

        Raises:
            UsageError: there is no such policy, or it sets an argument that defines the episode.
        """
        wanted: Any = getattr(self._maker(), "policy_options", {})
        if callable(wanted):
            try:
                wanted = wanted(task, **self.arguments)
            except _ENDINGS as error:
                _fail(f"policy {self.name}: its policy_options for {task.name}", error)
        if not isinstance(wanted, dict):
            raise UsageError(
                f"policy {self.name}: its policy_options is no dict, but {type(wanted).__name__}"
            )
        wrong = sorted(set(wanted) & set(FIXED))
        if wrong:
            raise UsageError(
                f"policy {self.name}: its policy_options has {', '.join(wrong)}, which the suite decides; a policy "
                "may set obs_mode, control_mode, reward_mode, cameras, sensor_configs and the like"
            )
        return dict(wanted)

    def digest(self) -> str:
        """Return a digest of its module's file and of the files and folders that its arguments name.

        A continued run uses finished tasks only if the digest is unchanged.
        """
        digest = hashlib.sha256()
        if self.name not in BUILT_IN:
            self._maker()  # makes the module importable
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
    """Wraps a policy; its errors and invalid actions are reported with policy, task and step."""

    def __init__(self, policy: Policy, name: str, env: gym.Env, timeout_s: float | None = None) -> None:
        self._policy, self._name, self._env, self._timeout_s = policy, name, env, timeout_s
        self._step = 0

    def reset(self) -> None:
        """Begin an episode."""
        self._step = 0
        try:
            with time_limit(self._timeout_s):
                begin_episode(self._policy)
        except _ENDINGS as error:
            _fail(f"policy {self._name}: reset() in {_where(self._env)}", error)

    def act(self, observation: Any) -> np.ndarray:
        """Return the policy's action, float32 (k,)."""
        self._step += 1
        try:
            with time_limit(self._timeout_s):
                answer: Any = self._policy.act(observation)
        except _ENDINGS as error:
            _fail(
                f"policy {self._name}: act() at step {self._step} of an episode of {_where(self._env)}", error
            )
        shape = action_shape(self._env)
        try:
            if answer is None:
                raise TypeError
            action = np.asarray(answer.detach().cpu() if hasattr(answer, "detach") else answer, np.float32)
            wrong = "" if action.shape == shape else f"an action of shape {action.shape}"
        except (TypeError, ValueError):
            wrong = f"{type(answer).__name__}, not an array of numbers"
        if not wrong and not np.isfinite(action).all():
            wrong = f"a non-finite action ({np.array2string(action, precision=3, threshold=8)})"
        if wrong:
            raise UsageError(
                f"policy {self._name}: act() returned {wrong} at step {self._step} of an episode of "
                f"{_where(self._env)}; expected {shape[0]} finite numbers, an array of shape {shape}"
            )
        return action


@contextmanager
def time_limit(seconds: float | None) -> Iterator[None]:
    """Interrupt the block with `PolicyTimeout` after so many seconds; None: never.

    Only the main thread of a process can be interrupted, and in Python code only; elsewhere there is no limit.
    """
    if (
        seconds is None
        or threading.current_thread() is not threading.main_thread()
        or not hasattr(signal, "setitimer")
    ):
        yield
        return

    def interrupt(*_: object) -> None:
        raise PolicyTimeout(f"it took longer than {seconds:g} s; allow more with --timeout")

    before = signal.signal(signal.SIGALRM, interrupt)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def _fail(what: str, error: BaseException) -> NoReturn:
    """Raise a policy's error as a `UsageError` with its place in the code; re-raise the project's own errors."""
    if isinstance(error, SimReconError):
        raise error
    frames = [f for f in traceback.extract_tb(error.__traceback__) if f.filename != __file__ and f.line]
    last = frames[-1] if frames else traceback.extract_tb(error.__traceback__)[-1]
    theirs = Path(last.filename).is_file() and last.filename != __file__
    at = f" ({last.filename}:{last.lineno})" if theirs else ""
    raise UsageError(
        f"{what} raised {type(error).__name__}: {error}{at}. SIMRECON_DEBUG=1 shows the whole traceback"
    ) from error


def _where(env: gym.Env) -> str:
    scene = scene_of(env)
    return f"{scene.scene_id}, {scene.task}, {scene.robot_uids}"


def _find(name: str) -> Callable:
    module_name, _, attribute = name.partition(":")
    if not module_name or not attribute:
        raise UsageError(
            f"policy {name!r}: expected {', '.join(BUILT_IN)} or module:callable, such as my_policy:Policy"
        )
    here = str(Path.cwd())
    if here not in sys.path:  # as `python -m` does; a console script does not
        sys.path.insert(0, here)
    try:
        found: Any = import_module(module_name)
    except ModuleNotFoundError as error:
        if error.name is None or (module_name != error.name and not module_name.startswith(error.name + ".")):
            raise UsageError(f"policy {name}: importing {module_name} needs the module {error.name!r}, which is "
                             "not installed") from error  # fmt: skip
        raise UsageError(
            f"policy {name}: there is no module {module_name!r} in this folder or installed; run from its folder"
        ) from error
    except _ENDINGS as error:
        _fail(f"policy {name}: importing {module_name}", error)
    for part in attribute.split("."):
        found = getattr(found, part, None)
    if not callable(found):
        raise UsageError(f"policy {name}: {module_name} has no callable {attribute!r}")
    return found
