"""Exports of phone apps, that hold images and poses: Record3D (`.r3d`, or unzipped) and Polycam's raw data.

Such a folder or file is an input of its own: stage 1 takes its images, stage 2 its poses.
"""

import json
import re
import zipfile
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np

from registry.errors import InputError

_SUFFIXES = (".jpg", ".jpeg", ".png")
_ARCHIVES = (".r3d", ".zip")


@dataclass(frozen=True)
class Export:
    """Where an export keeps its things; names are relative to its root, with slashes."""

    kind: str  # "record3d" | "polycam"
    path: Path  # a folder or a zip
    root: str  # folder inside a zip, or "": where names begin
    images: tuple[str, ...]  # in the order of frames
    cameras: str  # folder of the camera files (Polycam), or the metadata file (Record3D)

    def read(self, name: str) -> bytes:
        """Return the content of a file."""
        try:
            if self.path.is_dir():
                return (self.path / name).read_bytes()
            with zipfile.ZipFile(self.path) as archive:
                return archive.read(self.root + name)
        except (KeyError, OSError, zipfile.BadZipFile) as error:
            raise InputError(f"poses: {self.path} has no readable {name}: export it again") from error

    def read_json(self, name: str) -> dict:
        """Return the content of a JSON file."""
        try:
            return json.loads(self.read(name))
        except ValueError as error:
            raise InputError(f"poses: {name} in {self.path} is not JSON: export it again") from error

    def unpack_images(self, folder: Path) -> Path:
        """Return a folder with the images: the export's own, or `folder` with those of a zip written to it."""
        if self.path.is_dir():
            return (self.path / self.images[0]).parent
        with zipfile.ZipFile(self.path) as archive:
            for name in self.images:
                (folder / PurePosixPath(name).name).write_bytes(archive.read(self.root + name))
        return folder


def find_export(path: Path) -> Export | None:
    """Return what export a path is, or None where it is something else."""
    if path.is_dir():
        names = _names_in(path)
    elif path.is_file() and path.suffix.lower() in _ARCHIVES and zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as archive:
            names = [name for name in archive.namelist() if not name.endswith("/")]
    else:
        return None
    for depth in (0, 1):  # zips often have one folder around everything
        roots = {"/".join(n.split("/")[:depth]) + "/" * bool(depth) for n in names if n.count("/") >= depth}
        for root in sorted(roots) if path.is_file() or depth == 0 else []:
            found = _match(path, root, [n[len(root) :] for n in names if n.startswith(root)])
            if found is not None:
                return found
    return None


def _names_in(path: Path) -> list[str]:
    """List the files that matter: exports also hold thousands of depth maps."""
    names = [f.name for f in path.iterdir() if f.is_file()]
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
    """Sort key: img2 before img10."""
    return [(0, int(p), "") if p.isdigit() else (1, 0, p) for p in re.split(r"(\d+)", name.lower())]


def upright_turns(world_from_camera: np.ndarray) -> int:
    """Return the counter-clockwise quarter turns that bring images upright: cameras (n, 4, 4), world +y up."""
    ups = [-(world_from_camera[:, :3, :3] @ turned_camera(k)[:3, 1])[:, 1].mean() for k in range(4)]
    return int(np.argmax(ups))


def turned_camera(turns: int) -> np.ndarray:
    """Return camera_from_turned (4, 4): the camera of an image that was turned (`np.rot90(image, turns)`)."""
    quarter = np.array([[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
    return np.linalg.matrix_power(quarter, turns % 4)
