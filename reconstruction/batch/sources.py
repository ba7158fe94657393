"""Folders and lists of videos, on this machine or at an address of fsspec. All reading of them is here."""

import contextlib
import os
import posixpath
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from reconstruction.frames.decoding import IMAGE_SUFFIXES
from reconstruction.phone_exports.exports import find_export
from registry.errors import UsageError
from registry.exchange.place import open_path, place_errors, shown
from registry.roots import is_address

if TYPE_CHECKING:
    from reconstruction.batch.rows import AnyPath

BATCH_SUFFIX = ".batch"  # folder of a batch's results
VIDEO_SUFFIXES = (
    *(".3gp", ".avi", ".flv", ".gif", ".m2ts", ".m4v", ".mjpeg", ".mkv", ".mov", ".mp4", ".mpeg", ".mpg"),
    *(".mts", ".ogv", ".r3d", ".ts", ".webm", ".wmv"),
)


def path_of(address: str) -> "AnyPath":
    """Return the absolute path of a file or folder, or the path object of an address (`s3://bucket/films`).

    Raises:
        UsageError: there is no such protocol, or the address holds a password or a query.
        EnvironmentMissing: the extra of the protocol is not installed.
    """
    if is_address(address):
        if "@" in address or "?" in address:
            raise UsageError(
                f"{shown(address)}: the addresses of a batch stand in its journal: no user, password or query "
                "belongs there; clients find credentials by themselves (docs/sharing.md#credentials)"
            )
        return open_path(_without_dots(address.rstrip("/")))
    return Path(os.path.abspath(Path(address).expanduser()))  # noqa: PTH100 - keeps links as they are named


def _without_dots(address: str) -> str:
    """Return an address without `..`, which stands in lists and is no folder of an object store."""
    protocol, _, path = address.partition("://")
    return f"{protocol}://{posixpath.normpath(path)}" if ".." in path else address


@contextlib.contextmanager
def reading(path: "AnyPath") -> Iterator[None]:
    """Turn errors of an address into `EnvironmentMissing` while the block reads there."""
    with contextlib.nullcontext() if isinstance(path, Path) else place_errors(shown(str(path)), "read it"):
        yield


def read_list(path: "AnyPath") -> str:
    """Return the text of a list, UTF-8 with or without a byte-order mark.

    Raises:
        UsageError: it cannot be read, or is no UTF-8 text.
    """
    try:
        return path.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise UsageError(
            f"{path}: no UTF-8 text (byte {error.start}); save the list as CSV in UTF-8"
        ) from error
    except OSError as error:
        raise UsageError(f"{path}: cannot be read: {error.strerror or error}") from error


def videos_in(folder: "AnyPath") -> "tuple[list[AnyPath], list[str]]":
    """Return the videos of a folder in name order, and the names of files and folders that are none.

    A video is a file with a usual suffix, a folder that holds images, or an export of Record3D or Polycam. Hidden files
    and folders of results (`*.batch`) are skipped. Folders below are not searched.

    Raises:
        UsageError: the folder cannot be read.
    """
    found, others = [], []
    try:
        entries = sorted(folder.iterdir(), key=lambda entry: entry.name)
        for entry in entries:
            if entry.name.startswith(".") or entry.name.endswith(BATCH_SUFFIX):
                continue
            (found if is_video(entry) else others).append(entry)
    except OSError as error:
        raise UsageError(f"{folder}: cannot be read: {error.strerror or error}") from error
    return found, [entry.name for entry in others]


def is_video(path: "AnyPath") -> bool:
    """Return whether a path is a video by its name, or a folder that holds images."""
    if not isinstance(path, Path):  # exports are not looked into
        suffix = path.suffix.lower()
        return suffix in (*VIDEO_SUFFIXES, ".zip") or (not suffix and _holds_images(path))
    if path.is_dir():
        return _holds_images(path) or find_export(path) is not None
    if path.suffix.lower() == ".zip":
        return path.is_file() and find_export(path) is not None
    return path.is_file() and path.suffix.lower() in VIDEO_SUFFIXES


def _holds_images(folder: "AnyPath") -> bool:
    """Return whether a folder holds images that are not hidden."""
    return any(p.suffix.lower() in IMAGE_SUFFIXES for p in folder.iterdir() if not p.name.startswith("."))
