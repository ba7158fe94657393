"""A thread pool over frames."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

from reconstruction.core.progress import Progress


class Workers:
    """Runs a function for every frame on a few threads; kernels release the interpreter lock.

    Args:
        threads: number of threads; 0 is the number of usable cores.
    """

    def __init__(self, threads: int) -> None:
        usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 2
        self.threads = threads or usable

    def each(self, n: int, work: Callable[[int], None], label: str, progress: Progress) -> None:
        """Call work(i) for i < n and report each call as one unit of the step `label`."""
        progress.start(n, label)
        with ThreadPoolExecutor(self.threads) as pool:
            for _ in pool.map(work, range(n)):
                progress.advance()
