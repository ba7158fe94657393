"""Find and read exports of phone apps with images and poses: Record3D (`.r3d`, or unzipped) and Polycam's raw data.

Such a folder or file is a pipeline input: stage 1 reads its images, stage 2 its poses.
"""

import json
import re
import zipfile
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np

from reconstruction.phone_exports.archives import check_total, member_bytes, opened
from registry.errors import EnvironmentMissing, InputError

_SUFFIXES = (".jpg", ".jpeg", ".png")
_ARCHIVES = (".r3d", ".zip")
_MOST_JSON, _MOST_IMAGE = 32 << 20, 128 << 20  # bytes of a file


@dataclass(frozen=True)
class Export:
    """The files of an export; names are relative to its root, with slashes."""

    kind: str  # "record3d" | "polycam"
    path: Path  # a folder or a zip
    root: str  # folder inside of a zip that names are relative to, or ""
    images: tuple[str, ...]  # in frame order
    cameras: str  # folder of the camera files (Polycam), or the metadata file (Record3D)

    def read(self, name: str) -> bytes:
        """Read a file of at most 32 MB. Raises `InputError` where that fails, as does `read_json`."""
        if not self.path.is_dir():
            with opened(self.path) as archive:
                return member_bytes(archive, self.path, self.root + name, _MOST_JSON)
        try:
            with (self.path / name).open("rb") as stream:
                data = stream.read(_MOST_JSON + 1)
        except PermissionError as error:
            raise EnvironmentMissing(
                f"poses: {self.path / name}: {error.strerror}. Make it readable (chmod u+r) and run again."
            ) from error
        except OSError as error:
            raise InputError(f"poses: {self.path} has no readable {name}: export it again") from error
        if len(data) > _MOST_JSON:
            raise InputError(f"poses: {self.path / name} is larger than {_MOST_JSON >> 20} MB")
        return data

    def read_json(self, name: str) -> dict:
        """Read a JSON file."""
        content = self.read(name)
        try:
            data = json.loads(content)
        except (ValueError, RecursionError) as error:
            raise InputError(f"poses: {name} in {self.path} is not JSON: export it again") from error
        if not isinstance(data, dict):
            raise InputError(f"poses: {name} in {self.path} is not a JSON object: export it again")
        return data

    def unpack_images(self, folder: Path) -> Path:
        """Return a folder that holds the images: the export's own, or `folder`, to which those of a zip are written."""
        if self.path.is_dir():
            return (self.path / self.images[0]).parent
        with opened(self.path) as archive:
            check_total(archive, self.path, [self.root + name for name in self.images])
            for name in self.images:
                data = member_bytes(archive, self.path, self.root + name, _MOST_IMAGE)
                (folder / PurePosixPath(name).name).write_bytes(data)
        return folder


def find_export(path: Path) -> Export | None:
    """Detect whether a path is an export; None where it is not.

    Raises:
        InputError: it is a damaged archive.
    """
    if path.is_dir():
        names = _names_in(path)
    elif path.is_file() and path.suffix.lower() in _ARCHIVES:
        if not _is_zip(path):
            if path.suffix.lower() == ".r3d" and path.stat().st_size:
                raise InputError(f"{path} is no recording of Record3D, or only a part of one: copy it again")
            return None
        with opened(path) as archive:
            names = list(dict.fromkeys(name for name in archive.namelist() if not name.endswith("/")))
    else:
        return None
    for depth in (0, 1):  # the root, or a single folder around everything, as zips often have
        roots = {"/".join(n.split("/")[:depth]) + "/" * bool(depth) for n in names if n.count("/") >= depth}
        for root in sorted(roots) if path.is_file() or depth == 0 else []:
            found = _match(path, root, [n[len(root) :] for n in names if n.startswith(root)])
            if found is not None:
                return found
    return None


def _is_zip(path: Path) -> bool:
    """Return whether a file is a zip; `zipfile.is_zipfile` says no to a file that may not be read, too.

    Raises:
        EnvironmentMissing: it may not be read.
    """
    try:
        with path.open("rb") as stream:
            return zipfile.is_zipfile(stream)
    except PermissionError as error:
        raise EnvironmentMissing(
            f"{path}: {error.strerror}. Make it readable (chmod u+r) and run again."
        ) from error


def _names_in(path: Path) -> list[str]:
    """List the relevant files of a folder; exports also hold thousands of depth maps."""
    try:
        names = [f.name for f in path.iterdir() if f.is_file()]
    except PermissionError as error:
        raise EnvironmentMissing(
            f"{path}: {error.strerror}. Make the folder readable (chmod u+rx) and run again."
        ) from error
    for folder in ("rgb", "rgbd", *(f"keyframes/{x}" for x in _POLYCAM_FOLDERS)):
        if (path / folder).is_dir():
            names += [f"{folder}/{f.name}" for f in (path / folder).iterdir() if f.is_file()]
    return names


_POLYCAM_FOLDERS = ("corrected_cameras", "corrected_images", "cameras", "images")


def _match(path: Path, root: str, names: list[str]) -> Export | None:
    inside = set(names)

    def images_of(folder: str) -> tuple[str, ...]:
        found = [n for n in names if n.startswith(f"{folder}/") and n.lower().endswith(_SUFFIXES)]
        return tuple(sorted((n for n in found if n.count("/") == folder.count("/") + 1), key=natural))

    for metadata in ("metadata", "metadata.json"):
        for folder in ("rgb", "rgbd"):
            if metadata in inside and images_of(folder):
                return Export("record3d", path, root, images_of(folder), metadata)
    for prefix in ("corrected_", ""):
        images = images_of(f"keyframes/{prefix}images")
        cameras = f"keyframes/{prefix}cameras"
        if images and any(n.startswith(f"{cameras}/") and n.endswith(".json") for n in names):
            return Export("polycam", path, root, images, cameras)
    return None


def natural(name: str) -> list:
    """Return the sort key of natural name order: img2 before img10."""
    parts = [(p, p.lstrip("0")) for p in re.split(r"([0-9]+)", name.lower())]
    # Numbers compare by their length, then by their digits: without int, which has a limit of digits.
    return [
        (0, len(digits), digits) if part[:1] in tuple("0123456789") else (1, 0, part)
        for part, digits in parts
    ]


def upright_turns(world_from_camera: np.ndarray) -> int:
    """Return the counter-clockwise quarter turns that make images upright, from poses (n, 4, 4) in a +y up world."""
    ups = [-(world_from_camera[:, :3, :3] @ turned_camera(k)[:3, 1])[:, 1].mean() for k in range(4)]
    return int(np.argmax(ups))


def turned_camera(turns: int) -> np.ndarray:
    """Return camera_from_turned (4, 4) of an image turned by `np.rot90(image, turns)`."""
    quarter = np.array([[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
    return np.linalg.matrix_power(quarter, turns % 4)
