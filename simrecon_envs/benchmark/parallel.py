"""The same function on many things, in one process or in several; each has one thread."""

import gc
import multiprocessing
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from typing import Any

from registry import EnvironmentMissing, UsageError


class Workers:
    """Up to `jobs` processes that stay; one job runs here. Use as a context."""

    def __init__(self, jobs: int) -> None:
        if jobs < 1:
            raise UsageError(f"--jobs {jobs}: expected at least 1")
        self.jobs = jobs
        self._pool: ProcessPoolExecutor | None = None

    def __enter__(self) -> "Workers":
        """Start; processes begin with the first work."""
        self._frozen_before = gc.get_freeze_count()
        prepare_process()
        if self.jobs > 1:
            # A simulator must not be forked, so every process starts afresh.
            context = multiprocessing.get_context("spawn")
            self._pool = ProcessPoolExecutor(self.jobs, mp_context=context, initializer=prepare_process)
        return self

    def __exit__(self, *exc: object) -> None:
        """End the processes; what was not begun is dropped."""
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)
        if not self._frozen_before:
            gc.unfreeze()  # of whoever called, once more its own affair

    def map(
        self, function: Callable[..., Any], items: Sequence[Any], *arguments: Any
    ) -> Iterator[tuple[int, Any]]:
        """Yield (number, function(item, *arguments)) as they are done."""
        if self._pool is None:
            for number, item in enumerate(items):
                yield number, function(item, *arguments)
            return
        futures = {self._pool.submit(function, item, *arguments): n for n, item in enumerate(items)}
        for future in as_completed(futures):
            try:
                yield futures[future], future.result()
            except BrokenProcessPool as error:
                raise EnvironmentMissing(
                    f"one of {self.jobs} processes was ended from outside, most likely as memory ran out; run the same "
                    "command again with fewer --jobs: what was finished is kept"
                ) from error


def prepare_process() -> None:
    """Load the simulator, one thread: its arrays are small, and episodes must not differ with the machine.

    What is loaded is taken out of the garbage collection, which ManiSkill runs whenever a scene is built anew, that is
    before every episode, and which took a third of all time.
    """
    import torch

    import simrecon_envs.scene_env  # noqa: F401 - all that is heavy

    torch.set_num_threads(1)
    gc.collect()
    gc.freeze()
