"""Return the memory that a stage has freed to the operating system."""

import ctypes
import gc
from contextlib import suppress


def return_free_memory() -> None:
    """Give free memory of the C library's heap back to the operating system, where it is glibc.

    Its allocator keeps what was freed by many threads, so that the resident set of later stages would hold it, too.
    """
    gc.collect()
    with suppress(OSError, AttributeError):  # another C library
        ctypes.CDLL("libc.so.6").malloc_trim(0)
