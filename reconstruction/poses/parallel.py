"""Map a function over items on a pool of threads, results in the order of the items.

OpenCV, COLMAP and BLAS release the interpreter lock. Inside the pool, BLAS and OpenCV use one thread each: with their
own threads they wait for each other (measured: three times the CPU time on a busy machine).
"""

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import cv2

T = TypeVar("T")
R = TypeVar("R")


def usable_cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def ordered_map(function: Callable[[T], R], items: Iterable[T], most_threads: int = 256) -> Iterator[R]:
    """Yield function(item) for each item, in order; the first exception is raised and cancels the rest.

    `most_threads` bounds the memory of large items on machines with many cores.
    """
    from threadpoolctl import threadpool_limits

    cv2_threads = cv2.getNumThreads()
    with threadpool_limits(1, user_api="blas"), ThreadPoolExecutor(min(usable_cores(), most_threads)) as pool:
        cv2.setNumThreads(1)
        try:
            yield from pool.map(function, items)
        finally:
            pool.shutdown(cancel_futures=True)
            cv2.setNumThreads(cv2_threads)
