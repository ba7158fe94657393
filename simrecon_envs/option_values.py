"""Checks of the types and ranges of `SceneEnv`'s arguments, before anything is loaded or built."""

import functools
import inspect
import math
import re
from collections.abc import Sequence
from dataclasses import fields
from typing import Any

import numpy as np
from mani_skill.envs.sapien_env import BaseEnv

from registry import UsageError
from registry.errors import did_you_mean
from simrecon_envs.tasks import PickTaskConfig

RENDER_MODES = ("human", "rgb_array", "sensors", "all")
SIM_BACKENDS = ("auto", "cpu", "gpu", "cuda", "physx_cpu", "physx_cuda")
RENDER_BACKENDS = ("auto", "none", "cpu", "gpu", "cuda", "sapien_cpu", "sapien_cuda")
_REVISION = re.compile(r"[0-9a-f]{16}")


def check_count(name: str, value: Any) -> int:
    """Return a whole number, at least 1.

    Raises:
        UsageError: It is none; names the argument.
    """
    if isinstance(value, bool | np.bool_) or not isinstance(value, int | np.integer) or value < 1:
        raise UsageError(f"{name} {value!r}: expected a whole number, at least 1")
    return int(value)


def check_names(
    *,
    task: Any,
    target: Any,
    cameras: Any,
    obs_mode: Any,
    render_mode: Any,
    render_backend: Any,
    revision: Any,
) -> None:
    """Check the arguments that are names.

    Raises:
        UsageError: One has another type, or is unknown.
    """
    for name, value in (("task", task), ("render_backend", render_backend)):
        if not isinstance(value, str):
            raise UsageError(f"{name} {value!r}: expected text")
    if not isinstance(target, str | int | np.integer) or isinstance(target, bool):
        raise UsageError(f"target {target!r}: expected 'auto', the id of an object, or a label")
    if not isinstance(cameras, str | Sequence):
        raise UsageError(f"cameras {cameras!r}: expected names, as text with commas or a sequence")
    if obs_mode is not None and not isinstance(obs_mode, str):
        raise UsageError(f"obs_mode {obs_mode!r}: expected text, such as 'state' or 'rgb'")
    if render_mode is not None:
        _check_one_of("render_mode", render_mode, RENDER_MODES)
    if not render_backend.startswith("pci:"):  # SAPIEN's names of devices
        _check_one_of("render_backend", _without_number(render_backend), RENDER_BACKENDS)
    if revision is not None and not (isinstance(revision, str) and _REVISION.fullmatch(revision)):
        raise UsageError(f"revision {revision!r}: expected 16 hexadecimal digits")


def check_arguments(arguments: dict[str, Any]) -> None:
    """Check the arguments that `SceneEnv` passes to ManiSkill.

    Raises:
        UsageError: One is unknown, or has a wrong value.
    """
    known = _known_arguments()
    for name in arguments:
        if name not in known:
            raise UsageError(f"{name}: there is no such argument.{did_you_mean(name, known)}")
    check_count("num_envs", arguments.get("num_envs", 1))
    backend = arguments.get("sim_backend", "auto")
    _check_one_of("sim_backend", _without_number(backend), SIM_BACKENDS, shown=backend)


def check_noise(value: Any) -> tuple[float, float]:
    """Return `pose_noise` as shift (m) and turn (rad).

    Raises:
        UsageError: It is not one or two finite numbers, at least 0.
    """
    parts = (
        list(value)
        if isinstance(value, Sequence | np.ndarray) and not isinstance(value, str)
        else [value, 0.0]
    )
    numbers = [
        part for part in parts if isinstance(part, int | float | np.number) and not isinstance(part, bool)
    ]
    if len(parts) != 2 or len(numbers) != 2 or not all(math.isfinite(part) and part >= 0 for part in numbers):
        raise UsageError(f"pose_noise {value!r}: expected one or two finite numbers, at least 0")
    return float(numbers[0]), float(numbers[1])


def task_config(value: Any) -> PickTaskConfig:
    """Return the thresholds of picking from a dict or None.

    Raises:
        UsageError: A field is unknown, or no finite number.
    """
    if isinstance(value, PickTaskConfig):
        return value
    names = [item.name for item in fields(PickTaskConfig)]
    if value is not None and (not isinstance(value, dict) or set(value) - set(names)):
        raise UsageError(f"task_config {value!r}: expected a dict of {', '.join(names)}")
    for name, number in (value or {}).items():
        if not isinstance(number, int | float) or not math.isfinite(number):
            raise UsageError(f"task_config: {name}={number!r} is no finite number")
    return PickTaskConfig(**(value or {}))


@functools.cache
def _known_arguments() -> frozenset[str]:
    names = inspect.signature(BaseEnv.__init__).parameters
    return frozenset(names) - {"self"}


def _without_number(backend: Any) -> Any:
    """Return a backend without the number of its device: "cuda:1" is "cuda"."""
    return re.sub(r":\d+$", "", backend) if isinstance(backend, str) else backend


def _check_one_of(name: str, value: Any, known: tuple[str, ...], shown: Any = None) -> None:
    if value not in known:
        near = did_you_mean(str(value), known)
        value = value if shown is None else shown
        raise UsageError(f"{name} {value!r}: expected one of {', '.join(known)}.{near}")
