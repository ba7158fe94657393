# pyright: strict
"""Open files that someone else made: regular files only, never through a link."""

import os
import stat
from pathlib import Path
from typing import BinaryIO

from registry.errors import BundleError

_FLAGS = (
    os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_CLOEXEC", 0)
)


def open_regular(path: Path, name: str) -> tuple[BinaryIO, int]:
    """Open a regular file for reading; return it and its size in bytes. It never waits for a pipe.

    Raises:
        BundleError: `name` is a symbolic link, a pipe, a device or a folder.
        OSError: It does not exist or cannot be read.
    """
    try:
        descriptor = os.open(path, _FLAGS)
    except OSError:
        if path.is_symlink():
            raise BundleError(f"{name}: a symbolic link, not a plain file") from None
        raise
    info = os.fstat(descriptor)
    if not stat.S_ISREG(info.st_mode):
        os.close(descriptor)
        raise BundleError(f"{name}: not a plain file")
    return os.fdopen(descriptor, "rb"), info.st_size


def read_regular(path: Path, name: str, max_bytes: int) -> bytes:
    """Return the content of a regular file of at most `max_bytes`.

    Raises:
        BundleError: It is a link or no plain file, is too large, or changed while it was read.
        OSError: It does not exist or cannot be read.
    """
    file, size = open_regular(path, name)
    with file:
        if size > max_bytes:
            raise BundleError(f"{name}: {size} bytes, more than {max_bytes >> 20} MiB")
        data = file.read(size + 1)
    if len(data) != size:
        raise BundleError(f"{name}: it changed while it was read")
    return data
