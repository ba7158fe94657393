"""Shared locks on folders that several processes use: a folder is not removed while a process reads or fills it.

The locks are `flock` on the folder itself. They stay with it when it is renamed, and the kernel releases them when
their holder ends. On file systems without such locks nothing is locked.
"""

import contextlib
import os
import secrets
import shutil
from pathlib import Path

try:
    import fcntl
except ImportError:  # pragma: no cover - Windows
    fcntl = None


class Leases:
    """Shared locks that one process holds, at most one under each name."""

    def __init__(self) -> None:
        self._held: dict[str, int] = {}

    def take(self, name: str, folder: Path) -> bool:
        """Lock a folder under a name, and release what the name held; return False if the folder is gone.

        A folder that another process is removing counts as gone.
        """
        self.release(name)
        try:
            descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        except (FileNotFoundError, NotADirectoryError):
            return False
        if fcntl is not None:
            try:
                fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
            except BlockingIOError:
                os.close(descriptor)
                return False
            except OSError:  # no locks on this file system
                pass
        self._held[name] = descriptor
        try:
            same = os.path.samestat(os.fstat(descriptor), folder.stat())
        except FileNotFoundError:
            same = False
        if not same:
            self.release(name)
        return same

    def release(self, name: str) -> None:
        """Release the lock of a name, if it holds one."""
        descriptor = self._held.pop(name, None)
        if descriptor is not None:
            os.close(descriptor)

    def release_all(self) -> None:
        """Release all locks."""
        for name in list(self._held):
            self.release(name)


def remove_unless_leased(folder: Path) -> bool:
    """Remove a folder unless a process holds a shared lock on it; return whether it is gone."""
    try:
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    except OSError:
        return not os.path.lexists(folder)
    try:
        if fcntl is not None:
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                return False
            except OSError:  # no locks on this file system
                pass
        return remove_at_once(folder)
    finally:
        os.close(descriptor)


def remove_at_once(path: Path) -> bool:
    """Rename a file or folder to a temporary name, so that it disappears in one step, and delete it.

    Returns:
        Whether it is gone.
    """
    doomed = path.with_name(f"tmp-{os.getpid()}-gone-{secrets.token_hex(4)}")
    try:
        path.rename(doomed)
    except FileNotFoundError:
        return True
    except OSError:
        return False
    if doomed.is_dir() and not doomed.is_symlink():
        shutil.rmtree(doomed, ignore_errors=True)
    else:
        with contextlib.suppress(OSError):
            doomed.unlink()
    return True
