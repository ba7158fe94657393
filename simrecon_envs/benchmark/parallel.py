"""Map a function over items in one or several single-threaded processes."""

import gc
import multiprocessing
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from typing import Any

from registry import EnvironmentMissing, UsageError
from simrecon_envs.processes import in_worker, prepare_process, start_method


class Workers:
    """A pool of `jobs` processes; one job runs in this process. Use as a context manager."""

    def __init__(self, jobs: int) -> None:
        """Set the number of processes.

        Raises:
            UsageError: it is less than one.
        """
        if jobs < 1:
            raise UsageError(f"--jobs {jobs}: expected at least 1")
        self.jobs = jobs
        self._pool: ProcessPoolExecutor | None = None

    def __enter__(self) -> "Workers":
        """Prepare; processes start with the first item."""
        self._frozen_before = gc.get_freeze_count()
        prepare_process()
        if self.jobs > 1:
            context = multiprocessing.get_context(start_method())
            self._pool = ProcessPoolExecutor(
                self.jobs, mp_context=context, initializer=in_worker(prepare_process)
            )
        return self

    def __exit__(self, *exc: object) -> None:
        """End the processes; items that have not begun are dropped."""
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)
        if not self._frozen_before:
            gc.unfreeze()  # restore the caller's setting

    def map(
        self, function: Callable[..., Any], items: Sequence[Any], *arguments: Any
    ) -> Iterator[tuple[int, Any]]:
        """Yield (index, function(item, *arguments)) in the order of completion."""
        if self._pool is None:
            for number, item in enumerate(items):
                yield number, function(item, *arguments)
            return
        futures = {self._pool.submit(function, item, *arguments): n for n, item in enumerate(items)}
        try:
            for future in as_completed(futures):
                yield futures[future], future.result()
        except BrokenProcessPool as error:
            raise EnvironmentMissing(
                f"one of {self.jobs} processes was killed, most likely because memory ran out; run the same command "
                "again with fewer --jobs: finished work is kept"
            ) from error
