"""Processes that simulate: a fork server imports the simulator once, and each process begins with it imported."""

import gc
import multiprocessing
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing import forkserver
from typing import Any

_PRELOADED = "simrecon_envs.preloaded"


@contextmanager
def without_collection() -> Iterator[None]:
    """Pause garbage collection: among the imports of torch and ManiSkill it takes a fifth of the time."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def prepare_process() -> None:
    """Load the simulator and limit torch to one thread: arrays are small, and results must not depend on the machine.

    Loaded modules are frozen out of garbage collection. ManiSkill collects at every rebuild of a scene, that is before
    every episode, which took a third of the time. In a forked process, a collection would also copy all that it visits.
    """
    with without_collection():
        import torch

        import simrecon_envs.scene_env  # noqa: F401

    torch.set_num_threads(1)
    if _PRELOADED in sys.modules and multiprocessing.parent_process() is not None:
        return  # frozen by the fork server
    gc.collect()
    gc.freeze()


def prepare_worker() -> bool:
    """Prepare a process that was started for environments, and return whether this is one.

    Of any other process only torch is limited to one thread.
    """
    if multiprocessing.parent_process() is None:
        import torch

        torch.set_num_threads(1)
        return False
    prepare_process()
    return True


def start_method() -> str:
    """Return the start method of processes with environments: "forkserver" on Linux, else "spawn".

    The fork server of this process loads torch and ManiSkill when it starts, and makes no environment: a simulator must
    not be forked. A server that runs already stays as it is; its processes import for themselves.
    """
    if sys.platform != "linux":
        return "spawn"
    multiprocessing.set_forkserver_preload([_PRELOADED])
    forkserver.ensure_running()  # it loads while this process does
    return "forkserver"


def with_environment(function: Callable[..., Any], *arguments: Any) -> Callable[..., Any]:
    """Return a picklable function(*arguments, ...) that runs with the environment variables of now.

    Processes of a fork server have those of the time at which the server started.
    """
    return _WithEnvironment(function, arguments, dict(os.environ))


class _WithEnvironment:
    def __init__(
        self, function: Callable[..., Any], arguments: tuple[Any, ...], environment: dict[str, str]
    ) -> None:
        self.function, self.arguments, self.environment = function, arguments, environment

    def __call__(self, *more: Any) -> Any:
        if dict(os.environ) != self.environment:
            os.environ.clear()
            os.environ.update(self.environment)
        return self.function(*self.arguments, *more)
