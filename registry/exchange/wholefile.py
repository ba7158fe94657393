"""Write a local file so that it appears whole or not at all; remove what killed writers left beside it."""

import contextlib
import glob
import os
import secrets
import shutil
import tempfile
import time
from collections.abc import Generator
from pathlib import Path
from typing import BinaryIO

from registry.locks import is_leased, lease_folder

try:
    import fcntl
except ImportError:  # pragma: no cover - Windows
    fcntl = None

_GRACE_S = 60.0  # a temporary file or folder this young may belong to a writer that has not locked it yet


@contextlib.contextmanager
def whole_file(path: Path, *, sweep: str | None = None) -> Generator[BinaryIO, None, None]:
    """Open a temporary file beside `path` for writing; at the end of the block flush it to disk and rename it.

    The temporary file is locked while it is written. Unlocked ones are removed first: their writers were killed.

    Args:
        path: The file.
        sweep: Pattern of the file names whose temporary files are removed; None for that of `path` only.

    Raises:
        OSError: The file cannot be written; `path` is as it was.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    _sweep_files(path.parent, glob.escape(path.name) if sweep is None else sweep)
    partial = path.with_name(f".{path.name}.{os.getpid()}-{secrets.token_hex(4)}.tmp")
    try:
        with partial.open("xb") as stream:
            _try_lock(stream.fileno())
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
            partial.replace(path)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


@contextlib.contextmanager
def scratch_folder(prefix: str, parent: Path | None = None) -> Generator[Path, None, None]:
    """Make a private temporary folder for the block; remove those of killed processes with the same prefix.

    Args:
        prefix: Of its name.
        parent: Folder that it lies in; None for that of the system.

    Raises:
        OSError: No temporary folder can be made.
    """
    for old in (parent or Path(tempfile.gettempdir())).glob(f"{glob.escape(prefix)}*"):
        with contextlib.suppress(OSError):
            if old.is_dir() and not old.is_symlink() and _is_abandoned(old) and not is_leased(old):
                shutil.rmtree(old, ignore_errors=True)
    with tempfile.TemporaryDirectory(prefix=prefix, dir=parent) as name:
        lease = lease_folder(Path(name))
        try:
            yield Path(name)
        finally:
            if lease is not None:
                os.close(lease)


def _sweep_files(folder: Path, names: str) -> None:
    for old in folder.glob(f".{names}.*-????????.tmp"):
        with contextlib.suppress(OSError):
            if not _is_abandoned(old) or old.is_symlink():
                continue
            with old.open("rb") as stream:
                if _try_lock(stream.fileno()):
                    old.unlink()


def _is_abandoned(path: Path) -> bool:
    status = path.lstat()
    return status.st_uid == os.getuid() and time.time() - status.st_mtime > _GRACE_S


def _try_lock(descriptor: int) -> bool:
    """Lock an open file for this process without waiting; return whether that worked."""
    if fcntl is None:  # pragma: no cover - Windows
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True
