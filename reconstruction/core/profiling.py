"""Measure wall time, CPU time and peak memory of the process tree while a block of code runs."""

import contextlib
import re
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import psutil

_INTERVAL_S = 0.05  # between samples of memory
_REST = 9.0  # at least this many times what a sample took: the memory of large children takes the kernel 10 ms to count
_STATUS = Path("/proc/self/status")


@dataclass(frozen=True)
class Usage:
    """Resources that a stage used."""

    wall_s: float
    cpu_s: float
    peak_memory_mb: float  # MiB

    def followed_by(self, later: "Usage") -> "Usage":
        """Return the usage of both, run one after the other."""
        peak = max(self.peak_memory_mb, later.peak_memory_mb)
        return Usage(self.wall_s + later.wall_s, self.cpu_s + later.cpu_s, peak)


class UsageMeter:
    """Context manager that measures this process and its descendants while the body runs.

    Memory is the resident set of this process plus the unique set of each descendant, so that pages shared after a fork
    count once. It is sampled every 50 ms, less often where samples would take a tenth of a core. Where the kernel keeps
    a high-water mark, peaks of this process between two samples count, too. CPU time includes descendants that have
    ended.
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
        if (
            high_water > self._high_water_start
        ):  # The mark is of the whole life of the process: it rose in the body.
            self._peak = max(self._peak, high_water)
        self.usage = Usage(
            wall_s=time.perf_counter() - self._start,
            cpu_s=max(0.0, self._cpu() - self._cpu_start),
            peak_memory_mb=self._peak / 2**20,
        )

    def _cpu(self) -> float:
        """Return the CPU seconds of the tree so far, including children that have been waited for."""
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
            start = time.thread_time()
            self._peak = max(self._peak, sum(self._memory(process) for process in self._tree()))
            if self._stop.wait(max(_INTERVAL_S, _REST * (time.thread_time() - start))):
                return

    def _tree(self) -> list[psutil.Process]:
        return [self._process, *_descendants(self._process)]

    def _memory(self, process: psutil.Process) -> int:
        try:
            own = self._process.memory_info()
            if process == self._process:
                return own.rss
            other = process.memory_full_info()
            # Between vfork and exec a child has its parent's memory, which must not count twice. Parent and child are
            # read one after the other while the parent runs, hence the tolerances.
            alike = abs(other.vms - own.vms) < 0.05 * own.vms and abs(other.rss - own.rss) < 0.1 * own.rss
            borrowed = alike and other.uss > 0.5 * own.rss
            # If exec falls between the two reads of the child, `uss` is still the parent's.
            return 0 if borrowed else min(other.uss, other.rss)
        except (psutil.NoSuchProcess, psutil.AccessDenied):
            return 0


def _descendants(process: psutil.Process) -> list[psutil.Process]:
    """Return all descendants of a process.

    Linux lists the children of each thread. Listing all processes of the machine, as psutil does, costs milliseconds.
    """
    if not Path(f"/proc/{process.pid}/task/{process.pid}/children").exists():
        return process.children(recursive=True)
    found, todo = [], [process.pid]
    while todo:
        for listing in Path(f"/proc/{todo.pop()}/task").glob("*/children"):
            with contextlib.suppress(OSError):  # the thread has ended; below, the child
                todo += (pids := [int(text) for text in listing.read_text().split()])
                for pid in pids:
                    with contextlib.suppress(psutil.NoSuchProcess):
                        found.append(psutil.Process(pid))
    return found


def _high_water_bytes() -> int:
    """Return the largest resident set that this process ever had, 0 if the kernel does not report it."""
    try:
        found = re.search(r"^VmHWM:\s*(\d+) kB", _STATUS.read_text(), re.MULTILINE)
    except OSError:
        return 0
    return int(found[1]) * 1024 if found else 0
