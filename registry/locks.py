# pyright: strict
"""Interprocess locks: `flock` on files and folders. The kernel releases them when their holder dies.

Lock files are never deleted: if one were removed while another process opens it, two processes could lock the same
path.
"""

import contextlib
import os
import stat
from collections.abc import Generator
from pathlib import Path

from registry.errors import BundleError, EnvironmentMissing

try:
    import fcntl
except ImportError:  # pragma: no cover - Windows
    fcntl = None


class LockHeld(Exception):
    """Another process has the lock; `holder` describes it, if it is known."""

    def __init__(self, holder: str) -> None:
        super().__init__(holder)
        self.holder = holder


def _flock(descriptor: int, *, shared: bool = False, blocking: bool = False) -> None:
    if fcntl is None:  # pragma: no cover - Windows
        raise EnvironmentMissing("registry: this platform has no flock; use Linux, macOS or WSL")
    fcntl.flock(descriptor, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | (0 if blocking else fcntl.LOCK_NB))


@contextlib.contextmanager
def file_lock(path: Path, blocking: bool = True) -> Generator[None, None, None]:
    """Hold an exclusive lock on the file `path` (created if absent) while the block runs.

    Raises:
        LockHeld: The lock is taken and `blocking` is false.
        BundleError: The lock file or its folder is a link, or it is no plain file: something else would be written.
        OSError: The lock file cannot be created.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.parent.is_symlink() or path.is_symlink():
        raise BundleError(f"registry: the lock {path} is a symbolic link; remove it")
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK, 0o644)
    try:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise BundleError(f"registry: the lock {path} is not a plain file; remove it")
        try:
            _flock(descriptor, blocking=blocking)
        except BlockingIOError:
            holder = os.pread(descriptor, 200, 0).decode("utf-8", "replace").strip()
            raise LockHeld(holder or "an unknown process") from None
        if not blocking:  # the pid serves the error message of others, who do not wait either
            with contextlib.suppress(OSError):  # a full disk
                os.ftruncate(descriptor, 0)
                os.pwrite(descriptor, f"pid {os.getpid()}\n".encode(), 0)
        yield
    finally:
        os.close(descriptor)


def scene_lock(root: Path, scene_id: str, purpose: str) -> Path:
    """Return the lock file of a scene of the registry `root` for "publish" or "hold"."""
    return root / "locks" / f"{scene_id}.{purpose}.lock"


def is_locked(path: Path) -> bool:
    """Return whether any process holds the lock on the file `path`; creates nothing."""
    if fcntl is None:  # pragma: no cover - Windows
        return False
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)
    except OSError:
        return False
    try:
        _flock(descriptor, shared=True)
    except BlockingIOError:
        return True
    except OSError:
        return False
    else:
        return False
    finally:
        os.close(descriptor)


def lease_folder(folder: Path) -> int | None:
    """Take a shared lock on a folder, which keeps `SceneRegistry` from removing it.

    Returns:
        The open descriptor (close it to release the lock), or None if the file system has no such locks.
    """
    if fcntl is None:  # pragma: no cover - Windows
        return None
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        _flock(descriptor, shared=True)
    except OSError:
        os.close(descriptor)
        return None
    return descriptor


def is_leased(folder: Path) -> bool:
    """Return whether any process holds a shared lock on the folder."""
    if fcntl is None:  # pragma: no cover - Windows
        return False
    try:
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    except OSError:
        return False
    try:
        _flock(descriptor)
    except BlockingIOError:
        return True
    except OSError:
        return False
    else:
        return False
    finally:
        os.close(descriptor)
