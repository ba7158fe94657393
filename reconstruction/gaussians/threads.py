"""Run compiled kernels on several threads.

Kernels release the interpreter lock and run on plain threads. Numba's parallel loops would take five times as long to
compile, and their threads spin while waiting, which slows down a busy machine.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import pairwise
from typing import Any

_PIECES = 2  # pieces of work per thread, to balance uneven pieces


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="gaussians")


def thread_count() -> int:
    """Return the number of threads: NUMBA_NUM_THREADS, which is the number of usable cores unless it is set."""
    from numba.core import config

    return int(config.NUMBA_NUM_THREADS)  # pyright: ignore[reportAttributeAccessIssue]


def run_over(count: int, kernel: Callable[..., None], *arguments: Any) -> None:
    """Call kernel(start, stop, *arguments) for pieces of range(count) in parallel; pieces must not share outputs."""
    threads = thread_count()
    pieces = 1 if threads == 1 else min(threads * _PIECES, max(count, 1))
    bounds = [i * count // pieces for i in range(pieces + 1)]
    if pieces == 1:
        kernel(0, count, *arguments)
        return
    calls = [_pool(threads).submit(kernel, start, stop, *arguments) for start, stop in pairwise(bounds)]
    for call in calls:
        call.result()
