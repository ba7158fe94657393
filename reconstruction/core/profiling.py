"""Wall time, CPU time and peak memory of the process tree while a body of code runs."""

import contextlib
import re
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import psutil

_INTERVAL_S = 0.05
_STATUS = Path("/proc/self/status")


@dataclass(frozen=True)
class Usage:
    """What a stage cost."""

    wall_s: float
    cpu_s: float
    peak_memory_mb: float

    def followed_by(self, later: "Usage") -> "Usage":
        """Return what both cost, one after the other."""
        peak = max(self.peak_memory_mb, later.peak_memory_mb)
        return Usage(self.wall_s + later.wall_s, self.cpu_s + later.cpu_s, peak)


class UsageMeter:
    """Context manager that measures this process and everything that it starts while the body runs.

    Memory is what the whole tree occupied at once: this process's resident set plus what each descendant has for
    itself (pages that a fork shares with its parent count once). It is sampled every 50 ms; where the kernel keeps a
    high-water mark, a peak of this process that falls between two samples is still seen. CPU time covers descendants
    that ended as well as those that still run.
    """

    def __enter__(self) -> "UsageMeter":
        """Start measuring."""
        self._process = psutil.Process()
        self._stop = threading.Event()
        self._peak = 0
        self._high_water_start = _high_water_bytes()
        self._start, self._cpu_start = time.perf_counter(), self._cpu()
        self._thread = threading.Thread(target=self._sample, daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *exc: object) -> None:
        """Stop measuring; `usage` is then final."""
        self._stop.set()
        self._thread.join()
        high_water = _high_water_bytes()
        if high_water > self._high_water_start:  # The mark is of the process's life; it rose within the body.
            self._peak = max(self._peak, high_water)
        self.usage = Usage(
            wall_s=time.perf_counter() - self._start,
            cpu_s=max(0.0, self._cpu() - self._cpu_start),
            peak_memory_mb=self._peak / 2**20,
        )

    def _cpu(self) -> float:
        """Return the CPU seconds of the tree so far: its own, of children that were waited for, of living ones."""
        total = 0.0
        for process in self._tree():
            try:
                times = process.cpu_times()
            except (psutil.NoSuchProcess, psutil.AccessDenied):
                continue
            total += times.user + times.system + times.children_user + times.children_system
        return total

    def _sample(self) -> None:
        while True:
            self._peak = max(self._peak, sum(self._memory(process) for process in self._tree()))
            if self._stop.wait(_INTERVAL_S):
                return

    def _tree(self) -> list[psutil.Process]:
        return [self._process, *_descendants(self._process)]

    def _memory(self, process: psutil.Process) -> int:
        try:
            own = self._process.memory_info()
            if process == self._process:
                return own.rss
            other = process.memory_full_info()
            # Between vfork and exec a child has no memory of its own, but the parent's: it must not count twice.
            # The two are read one after the other, while the parent goes on, so that they agree but nearly.
            alike = abs(other.vms - own.vms) < 0.05 * own.vms and abs(other.rss - own.rss) < 0.1 * own.rss
            borrowed = alike and other.uss > 0.5 * own.rss
            # If it began its own program between the two reads, what it had for itself is the parent's still.
            return 0 if borrowed else min(other.uss, other.rss)
        except (psutil.NoSuchProcess, psutil.AccessDenied):
            return 0


def _descendants(process: psutil.Process) -> list[psutil.Process]:
    """Return the children of a process and theirs.

    Linux lists the children of a thread; asking for all processes of the machine, as psutil does, costs milliseconds.
    """
    if not Path(f"/proc/{process.pid}/task/{process.pid}/children").exists():
        return process.children(recursive=True)
    found, todo = [], [process.pid]
    while todo:
        for listing in Path(f"/proc/{todo.pop()}/task").glob("*/children"):
            with contextlib.suppress(OSError):  # The thread ended in the meantime, or below, the child.
                todo += (pids := [int(text) for text in listing.read_text().split()])
                for pid in pids:
                    with contextlib.suppress(psutil.NoSuchProcess):
                        found.append(psutil.Process(pid))
    return found


def _high_water_bytes() -> int:
    """Return the largest resident set that this process ever had, 0 where the kernel does not tell."""
    try:
        found = re.search(r"^VmHWM:\s*(\d+) kB", _STATUS.read_text(), re.MULTILINE)
    except OSError:
        return 0
    return int(found[1]) * 1024 if found else 0
