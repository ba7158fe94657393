"""Compiled loops over several threads.

Plain threads around kernels that release the interpreter lock, instead of Numba's parallel loops: those take five
times as long to compile, and their threads spin while they wait, which slows everything else on a busy machine.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import pairwise
from typing import Any

_PIECES = 2  # pieces a thread, so that an uneven share of the work does not hold up the rest


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="gaussians")


def thread_count() -> int:
    """Return the number of threads: the usable cores, or NUMBA_NUM_THREADS."""
    import numba

    return int(numba.config.NUMBA_NUM_THREADS)


def run_over(count: int, kernel: Callable[..., None], *arguments: Any) -> None:
    """Call kernel(start, stop, *arguments) for pieces of range(count); each piece writes only what is its own."""
    threads = thread_count()
    pieces = 1 if threads == 1 else min(threads * _PIECES, max(count, 1))
    bounds = [i * count // pieces for i in range(pieces + 1)]
    if pieces == 1:
        kernel(0, count, *arguments)
        return
    calls = [_pool(threads).submit(kernel, start, stop, *arguments) for start, stop in pairwise(bounds)]
    for call in calls:
        call.result()
