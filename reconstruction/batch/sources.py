"""The places that lists and folders of videos are read from. All reading of them is here."""

import os
from pathlib import Path

from reconstruction.frames.decoding import IMAGE_SUFFIXES
from reconstruction.phone_exports.exports import find_export
from registry.errors import UsageError

BATCH_SUFFIX = ".batch"  # folder of a batch's results
VIDEO_SUFFIXES = (
    *(".3gp", ".avi", ".flv", ".gif", ".m2ts", ".m4v", ".mjpeg", ".mkv", ".mov", ".mp4", ".mpeg", ".mpg"),
    *(".mts", ".ogv", ".r3d", ".ts", ".webm", ".wmv"),
)


def local_path(address: str) -> Path:
    """Return the absolute path of an address.

    Raises:
        UsageError: it is an address of another machine (`scheme://…`).
    """
    if "://" in address:
        raise UsageError(
            f"{address}: videos and lists are read from folders; copy or mount it first "
            "(for example `aws s3 sync`, or a mount by rclone)"
        )
    return Path(os.path.abspath(Path(address).expanduser()))  # noqa: PTH100 - keeps links as they are named


def read_list(path: Path) -> str:
    """Return the text of a list, UTF-8 with or without a byte-order mark.

    Raises:
        UsageError: it cannot be read, or is no UTF-8 text.
    """
    try:
        return path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise UsageError(
            f"{path}: no UTF-8 text (byte {error.start}); save the list as CSV in UTF-8"
        ) from error
    except OSError as error:
        raise UsageError(f"{path}: cannot be read: {error.strerror or error}") from error


def videos_in(folder: Path) -> tuple[list[Path], list[str]]:
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


def is_video(path: Path) -> bool:
    """Return whether a path is a video by its name, or a folder that holds images."""
    if path.is_dir():
        inside = any(p.suffix.lower() in IMAGE_SUFFIXES for p in path.iterdir() if not p.name.startswith("."))
        return inside or find_export(path) is not None
    if path.suffix.lower() == ".zip":
        return path.is_file() and find_export(path) is not None
    return path.is_file() and path.suffix.lower() in VIDEO_SUFFIXES
