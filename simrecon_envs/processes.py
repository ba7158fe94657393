"""Processes that simulate: a fork server imports the simulator once, and each process begins with it imported."""

import gc
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from simrecon_envs.collection import without_collection

_PRELOADED = "simrecon_envs.preloaded"


def prepare_process() -> None:
    """Load the simulator and limit torch to one thread: arrays are small, and results must not depend on the machine.

    Loaded modules are frozen out of garbage collection. ManiSkill collects at every rebuild of a scene, that is before
    every episode, which took a third of the time. In a forked process, a collection would also copy all that it visits.
    """
    with without_collection():
        import torch

        import simrecon_envs.scene_env  # noqa: F401

    torch.set_num_threads(1)
    if not gc.get_freeze_count():  # a fork server has frozen them already
        gc.collect()
        gc.freeze()


def start_method() -> str:
    """Return the start method of processes with environments: "forkserver" on Linux, else "spawn".

    The fork server of this process loads torch and ManiSkill when it starts, and makes no environment: a simulator must
    not be forked. A server that runs already stays as it is; its processes import for themselves.
    """
    if sys.platform != "linux":
        return "spawn"
    import multiprocessing
    from multiprocessing import forkserver

    multiprocessing.set_forkserver_preload([_PRELOADED])
    forkserver.ensure_running()  # it loads while this process does
    return "forkserver"


def in_worker(function: Callable[..., Any], *arguments: Any) -> Callable[..., Any]:
    """Return a picklable function(*arguments, ...) that prepares the process that it runs in, if it is another one.

    That process gets the environment variables of now: a fork server's are those of the time at which it started.
    """
    return _InWorker(function, arguments, dict(os.environ), os.getpid())


@dataclass(frozen=True)
class _InWorker:
    function: Callable[..., Any]
    arguments: tuple[Any, ...]
    environment: dict[str, str]
    asker: int  # process

    def __call__(self, *more: Any) -> Any:
        if os.getpid() != self.asker:
            os.environ.clear()
            os.environ.update(self.environment)
            prepare_process()
        return self.function(*self.arguments, *more)
