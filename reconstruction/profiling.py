"""Wall time, CPU time and peak memory of the process tree, per stage."""

import threading
import time
from dataclasses import dataclass

import psutil

_INTERVAL_S = 0.1


@dataclass(frozen=True)
class Usage:
    """What a stage cost."""

    wall_s: float
    cpu_s: float
    peak_memory_mb: float


class UsageMeter:
    """Context manager that samples the memory of this process and its children while the body runs."""

    def __enter__(self) -> "UsageMeter":
        """Start measuring."""
        self._process = psutil.Process()
        self._stop = threading.Event()
        self._peak = 0
        self._start, self._cpu_start = time.perf_counter(), self._cpu()
        self._thread = threading.Thread(target=self._sample, daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *exc: object) -> None:
        """Stop measuring; `usage` is then final."""
        self._stop.set()
        self._thread.join()
        self.usage = Usage(
            wall_s=time.perf_counter() - self._start,
            cpu_s=self._cpu() - self._cpu_start,
            peak_memory_mb=self._peak / 2**20,
        )

    def _cpu(self) -> float:
        times = self._process.cpu_times()
        return times.user + times.system + times.children_user + times.children_system

    def _sample(self) -> None:
        while True:
            total = 0
            for process in [self._process, *self._process.children(recursive=True)]:
                try:
                    # Shared pages (libraries, memory-mapped arrays) of a child count once: its unique part only.
                    memory = process.memory_info()
                    total += memory.rss if process == self._process else max(0, memory.rss - memory.shared)
                except (psutil.NoSuchProcess, psutil.AccessDenied):
                    continue
            self._peak = max(self._peak, total)
            if self._stop.wait(_INTERVAL_S):
                return
