"""Engine on this machine: each video is a process; cores and memory bound how many run at once."""

import queue
import threading
from dataclasses import replace

from reconstruction.batch.attempt import Job, run_attempt
from reconstruction.batch.engines.base import Resources, free_memory_mb, total_memory_mb
from reconstruction.batch.outcomes import CURES, Outcome, plain

_CLOSE_S = 40.0


class LocalEngine:
    """Runs jobs as processes of this machine, one thread each to wait for it.

    A video gets its own CPU cores where there are enough. Beside running ones, another is started only if the memory
    that it reserves is free.
    """

    name = "local"

    def __init__(self, resources: Resources) -> None:
        self._cpus = resources.usable_cores()
        self._at_once = resources.at_once
        self._ended: queue.Queue[tuple[Job, Outcome]] = queue.Queue()
        self._stop = threading.Event()
        self._running: dict[str, tuple[Job, threading.Thread]] = {}
        self.places = max(1, resources.at_once)

    def _places_of(self, job: Job) -> int:
        by_cores = max(1, len(self._cpus) // max(1, job.cores))
        by_memory = max(1, total_memory_mb() // max(1, job.memory_mb)) if job.memory_mb else by_cores
        return self._at_once or min(by_cores, by_memory)

    def room(self, job: Job) -> bool:
        """See `Engine.room`."""
        self.places = self._places_of(job)
        if not self._running:
            return True
        return len(self._running) < self.places and free_memory_mb() >= job.memory_mb

    def start(self, job: Job) -> None:
        """See `Engine.start`."""
        job = replace(job, pinned=self._free_cpus(job.cores))
        thread = threading.Thread(target=self._run, args=(job,), name=job.scene_id, daemon=True)
        self._running[job.scene_id] = (job, thread)
        thread.start()

    def _free_cpus(self, cores: int) -> tuple[int, ...]:
        """Return CPUs that no running job has; empty (any) if there are too few, or if one job may use all."""
        taken = {cpu for job, _ in self._running.values() for cpu in job.pinned}
        free = [cpu for cpu in self._cpus if cpu not in taken]
        return tuple(free[:cores]) if cores <= len(free) and self.places > 1 else ()

    def _run(self, job: Job) -> None:
        try:
            outcome = run_attempt(job, self._stop)
        except Exception as error:  # a bug must not lose the video
            outcome = Outcome("bug", plain(f"{type(error).__name__}: {error}"), CURES["bug"])
        self._ended.put((job, outcome))

    def finished(self, timeout_s: float) -> list[tuple[Job, Outcome]]:
        """See `Engine.finished`."""
        found = []
        try:
            found.append(self._ended.get(timeout=timeout_s))
            while True:
                found.append(self._ended.get_nowait())
        except queue.Empty:
            pass
        for job, _ in found:
            self._running.pop(job.scene_id)[1].join()
        return found

    def stop(self) -> None:
        """See `Engine.stop`."""
        self._stop.set()

    def close(self) -> None:
        """See `Engine.close`."""
        self._stop.set()
        for _, thread in self._running.values():
            thread.join(_CLOSE_S)
