"""Several environments at once.

With CUDA, one environment simulates all of them: `simrecon_envs.make(scene, num_envs=1024)`. On the CPU, PhysX
takes one scene a process: `make_vec` starts the processes.
"""

import functools
from pathlib import Path
from typing import Any

from registry import UsageError
from simrecon_envs.registration import make_cpu

KINDS = ("sync", "async", "sb3")


def make_vec(
    scene: str,
    num_envs: int,
    *,
    kind: str = "async",
    seed: int | None = None,
    registry: Path | str | None = None,
    **kwargs: Any,
) -> Any:
    """Make several environments of a scene with NumPy observations.

    Args:
        scene: As for `make`.
        num_envs: How many; one process each, but for "sync".
        kind: "async" and "sync" are Gymnasium's `AsyncVectorEnv` and `SyncVectorEnv`, "sb3" is
            stable-baselines3's `SubprocVecEnv` (`DummyVecEnv` for one environment) with its `VecMonitor`.
        seed: Seeds "sb3" environments, one number each from here; Gymnasium's are seeded at `reset`.
        registry: The registry's folder; the default registry where left out.
        **kwargs: As for `make`.

    Raises:
        UsageError: there is no such kind, or fewer than one environment.
    """
    if kind not in KINDS:
        raise UsageError(f"make_vec: kind {kind!r} is not one of {', '.join(KINDS)}")
    if num_envs < 1:
        raise UsageError(f"make_vec: num_envs={num_envs} is not at least 1")
    # A picklable function: a simulator must not be forked, so every process starts afresh.
    makers = [functools.partial(make_one, scene, registry, kwargs)] * num_envs
    if kind == "sb3":
        from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecMonitor

        vec = SubprocVecEnv(makers, start_method="spawn") if num_envs > 1 else DummyVecEnv(makers)
        vec.seed(seed)
        return VecMonitor(vec, info_keywords=())
    from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv

    return SyncVectorEnv(makers) if kind == "sync" else AsyncVectorEnv(makers, context="spawn")


def make_one(scene: str, registry: Path | str | None, kwargs: dict[str, Any]) -> Any:
    """Make one of the environments, in a process of its own with one thread."""
    import torch

    torch.set_num_threads(1)
    return make_cpu(scene, registry=registry, **kwargs)
