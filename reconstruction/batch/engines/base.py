"""Interface of an engine, the resources that it divides, and the choice of one by name."""

import os
from dataclasses import dataclass
from importlib import import_module
from typing import Protocol

import psutil

from reconstruction.batch.attempt import Job
from reconstruction.batch.outcomes import Outcome
from registry.errors import UsageError

BUILT_IN = {
    "local": "reconstruction.batch.engines.local:LocalEngine",
    "ray": "reconstruction.batch.engines.on_ray:RayEngine",
}
CORES = {"fast": 2, "default": 2, "quality": 4}
"""CPU cores of one video by preset."""
MEMORY_MB = {"fast": 2000, "default": 2500, "quality": 4000}
"""Memory of one video by preset, MiB: the peaks of docs/benchmarks.md and a reserve."""


@dataclass(frozen=True)
class Resources:
    """Resources that an engine divides among videos."""

    at_once: int = 0  # most videos at the same time; 0: as many as cores and memory allow
    cores: int = 0  # CPU cores to use in all; 0: all of this machine
    address: str | None = None  # of a cluster

    def usable_cores(self) -> tuple[int, ...]:
        """Return the numbers of the CPUs to use."""
        if hasattr(os, "sched_getaffinity"):
            found = sorted(os.sched_getaffinity(0))
        else:
            found = list(range(os.cpu_count() or 1))
        return tuple(found[: self.cores] if self.cores else found)


class Engine(Protocol):
    """Runs jobs by `run_attempt`, on any machine. The driver calls all methods from one thread."""

    name: str
    places: int  # how many videos run at the same time, for the estimate of the time left

    def room(self, job: Job) -> bool:
        """Return whether this job can be handed over now."""
        ...

    def start(self, job: Job) -> None:
        """Begin a job."""
        ...

    def finished(self, timeout_s: float) -> list[tuple[Job, Outcome]]:
        """Return the jobs that have ended since the last call; wait for one at most `timeout_s`."""
        ...

    def stop(self) -> None:
        """Ask all running jobs to end gently; `finished` reports them as interrupted."""
        ...

    def close(self) -> None:
        """End all running jobs at once, and free the engine."""
        ...


def load_engine(name: str, resources: Resources) -> Engine:
    """Return an engine: `local`, `ray`, or `module:Class` of another package, which is called with the resources.

    Raises:
        UsageError: there is no such engine.
        EnvironmentMissing: it needs a package that is not installed.
    """
    address = BUILT_IN.get(name, name)
    module, colon, attribute = address.partition(":")
    try:
        if not colon:
            raise ImportError(f"no engine {name!r}")
        made = getattr(import_module(module), attribute)
    except (ImportError, AttributeError) as error:
        if name in BUILT_IN:
            raise
        known = ", ".join(BUILT_IN)
        raise UsageError(f"--engine {name}: {error}; there are {known}, or give module:Class") from error
    return made(resources)


def free_memory_mb() -> int:
    """Return the memory that programs can still take on this machine, MiB."""
    return psutil.virtual_memory().available >> 20


def total_memory_mb() -> int:
    """Return the memory of this machine, MiB."""
    return psutil.virtual_memory().total >> 20
