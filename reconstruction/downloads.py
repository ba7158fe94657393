"""Videos at addresses: an fsspec address in, the path of a copy on this machine out.

A copy lies in `$SIMRECON_HOME/videos/<digest>/<name>`. The digest covers the address, and name, size and version of
each file there, so a video is downloaded once, and again when it has changed. A copy may be deleted at any time.
"""

import contextlib
import hashlib
import logging
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from registry.errors import EnvironmentMissing, UsageError
from registry.exchange.place import open_path, place_errors, shown
from registry.exchange.wholefile import scratch_folder
from registry.roots import home_folder, is_address

if TYPE_CHECKING:
    from upath import UPath

logger = logging.getLogger(__name__)
_FOLDER = "videos"
_VERSIONS = ("ETag", "etag", "LastModified", "last_modified", "mtime", "created")  # of fsspec's clients
_MOST_FILES = 20_000


def local_copy(address: str, say: Callable[[str], None] = logger.info) -> Path:
    """Return the path of a video, or of a folder of images, on this machine; downloads it if it is not there.

    Args:
        address: of a file or a folder.
        say: receives one line before a download.

    Raises:
        UsageError: there is nothing at the address.
        EnvironmentMissing: the address cannot be reached, or the disk is full.
    """
    source, files = _listed(address)
    folder = _copy_folder(source, files)
    if not folder.is_dir():
        say(f"downloading {shown(address)}, {sum(size for _, size, _ in files) / 1e6:.1f} MB, to {folder}")
        with place_errors(shown(address), "download it"):
            _download(source, files, folder)
    return folder / source.name


def as_local(video: Path | str) -> Path:
    """Return the path of a video on this machine: of an address, that of its copy (`local_copy`)."""
    return local_copy(video) if isinstance(video, str) and is_address(video) else Path(video)


def drop_copy(address: str) -> None:
    """Delete the copy of a video on this machine, if there is one; errors as of `local_copy`."""
    shutil.rmtree(_copy_folder(*_listed(address)), ignore_errors=True)


def files_of(source: "UPath") -> list[tuple[str, int, str]]:
    """Return (path, bytes, version) of a file, or of all files below a folder, ordered by path; reaches the network.

    A film costs one request, a folder two. Paths are those of its file system.

    Raises:
        UsageError: there is nothing, or far more than a video.
        EnvironmentMissing: the address cannot be reached.
    """
    name = shown(str(source))
    with place_errors(name, "list it"):
        try:
            found: dict = {source.path: source.fs.info(source.path)}
            if found[source.path]["type"] == "directory":
                found = dict(source.fs.find(source.path, detail=True))
        except FileNotFoundError:  # nor a bucket
            found = {}
        if not found:
            raise UsageError(f"{name}: no such file, and no folder of images")
        if len(found) > _MOST_FILES:
            raise UsageError(f"{name}: more than {_MOST_FILES} files; name one video, or a folder of images")
    return [(path, int(info.get("size") or 0), _version(info)) for path, info in sorted(found.items())]


def _listed(address: str) -> tuple["UPath", list[tuple[str, int, str]]]:
    source = open_path(address.rstrip("/"))
    return source, files_of(source)


def _version(info: dict) -> str:
    return next((str(info[name]) for name in _VERSIONS if info.get(name)), "")


def _copy_folder(source: "UPath", files: list[tuple[str, int, str]]) -> Path:
    said = [str(source), *(f"{path}\n{size}\n{version}" for path, size, version in files)]
    return home_folder() / _FOLDER / hashlib.sha256("\n".join(said).encode()).hexdigest()[:16]


def _download(source: "UPath", files: list[tuple[str, int, str]], folder: Path) -> None:
    """Download files into a new folder, which appears whole or not at all."""
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        with scratch_folder(f".{folder.name}-", folder.parent) as scratch:
            for path, _, _ in files:
                target = scratch / folder.name / source.name / path.removeprefix(source.path).lstrip("/")
                target.parent.mkdir(parents=True, exist_ok=True)
                source.fs.get_file(path, str(target))
            with contextlib.suppress(OSError):  # another process has put it there
                (scratch / folder.name).rename(folder)
    except OSError as error:
        if not str(error.filename or "").startswith(str(folder.parent)):
            raise  # of the address
        raise EnvironmentMissing(
            f"{shown(str(source))}: cannot be downloaded to {folder.parent}: {error.strerror}. Free some space, or "
            "choose another $SIMRECON_HOME"
        ) from error
    if not folder.is_dir():
        raise EnvironmentMissing(f"{folder}: cannot be made; choose another $SIMRECON_HOME")
