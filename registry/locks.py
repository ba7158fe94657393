"""Locks between processes: `flock` on files and folders. The kernel frees them when their holder dies.

Lock files are never deleted: removing one while another process opens it would let two processes both "hold"
it.
"""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

from registry.errors import EnvironmentMissing

try:
    import fcntl
except ImportError:  # pragma: no cover - Windows
    fcntl = None


class LockHeld(Exception):
    """Another holder has the lock; `.holder` says who, as far as it is known."""

    def __init__(self, holder: str) -> None:
        super().__init__(holder)
        self.holder = holder


def _flock(descriptor: int, operation: int) -> None:
    if fcntl is None:  # pragma: no cover - Windows
        raise EnvironmentMissing("registry: this platform has no flock; use Linux, macOS or WSL")
    fcntl.flock(descriptor, operation)


@contextlib.contextmanager
def file_lock(path: Path, blocking: bool = True) -> Iterator[None]:
    """Hold an exclusive lock on the file `path` (created where absent) while the block runs.

    Raises:
        LockHeld: it is taken and `blocking` is False.
        OSError: the lock file cannot be created.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    try:
        try:
            _flock(descriptor, fcntl.LOCK_EX | (0 if blocking else fcntl.LOCK_NB))
        except BlockingIOError:
            holder = os.pread(descriptor, 200, 0).decode("utf-8", "replace").strip()
            raise LockHeld(holder or "an unknown process") from None
        # The pid is only for the message of whoever finds the lock taken, so a full disk must not matter
        # here.
        with contextlib.suppress(OSError):
            os.ftruncate(descriptor, 0)
            os.pwrite(descriptor, f"pid {os.getpid()}\n".encode(), 0)
        yield
    finally:
        os.close(descriptor)


def lease_folder(folder: Path) -> int | None:
    """Take a shared lock on a folder, so that nobody removes it while it is read.

    Returns the open descriptor (close it to end the lease), or None where the file system has no such locks.
    """
    if fcntl is None:  # pragma: no cover - Windows
        return None
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        _flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError:
        os.close(descriptor)
        return None
    return descriptor


def is_leased(folder: Path) -> bool:
    """Tell whether somebody reads the folder under a lease."""
    if fcntl is None:  # pragma: no cover - Windows
        return False
    try:
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    except OSError:
        return False
    try:
        _flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False
    else:
        return False
    finally:
        os.close(descriptor)
