"""Threads that work on frames beside each other."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

from reconstruction.core.progress import Progress


class Workers:
    """Runs a function for every frame on a few threads; the kernels release the interpreter."""

    def __init__(self, threads: int):
        import os

        self.threads = (
            threads or len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else threads or 2
        )

    def each(self, n: int, work: Callable[[int], None], label: str, progress: Progress) -> None:
        progress.start(n, label)
        with ThreadPoolExecutor(self.threads) as pool:
            for _ in pool.map(work, range(n)):
                progress.advance()
