"""Vectorized environments on the CPU.

With CUDA, one environment simulates many scenes: `simrecon_envs.make(scene, num_envs=1024)`. On the CPU, ManiSkill
simulates one environment per process: `make_vec` starts the processes.
"""

from pathlib import Path
from typing import Any

from registry import UsageError
from simrecon_envs.processes import in_worker, start_method
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
        scene: See `make`.
        num_envs: Number of environments; one process each, except for "sync".
        kind: "async" and "sync" are Gymnasium's `AsyncVectorEnv` and `SyncVectorEnv`, "sb3" is
            stable-baselines3's `SubprocVecEnv` (`DummyVecEnv` for one environment) with its `VecMonitor`.
        seed: Seed of the first "sb3" environment, increasing by 1; Gymnasium's are seeded by `reset`.
        registry: Folder of the registry; None for the default one.
        **kwargs: See `make`.

    Raises:
        UsageError: The kind is unknown, or `num_envs` is below 1.
    """
    if kind not in KINDS:
        raise UsageError(f"make_vec: kind {kind!r} is not one of {', '.join(KINDS)}")
    if num_envs < 1:
        raise UsageError(f"make_vec: num_envs={num_envs} is not at least 1")
    method = start_method() if kind == "async" or (kind == "sb3" and num_envs > 1) else None
    makers = [in_worker(make_one, scene, registry, kwargs)] * num_envs
    if kind == "sb3":
        from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecMonitor

        vec = SubprocVecEnv(makers, start_method=method) if method else DummyVecEnv(makers)
        vec.seed(seed)
        return VecMonitor(vec, info_keywords=())
    from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv

    return SyncVectorEnv(makers) if kind == "sync" else AsyncVectorEnv(makers, context=method)


def make_one(scene: str, registry: Path | str | None, kwargs: dict[str, Any]) -> Any:
    """Make one environment in its own process, and limit torch to one thread."""
    import torch

    torch.set_num_threads(1)
    return make_cpu(scene, registry=registry, **kwargs)
