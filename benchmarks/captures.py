"""Captures on disk: a video or a folder of images, with or without ground truth beside it."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from reconstruction.cache import digest_input
from registry.errors import UsageError

_IMAGE_SUFFIXES = {".jpg", ".jpeg", ".png"}
# "scene": cameras, entities and their meshes; "cameras": cameras and perhaps depth; CONTRACT section 3.
Truth = Literal["scene", "cameras", "none"]
TRUTH_ORDER: tuple[Truth, ...] = ("none", "cameras", "scene")


@dataclass(frozen=True)
class Capture:
    """One capture to reconstruct and to measure."""

    name: str
    source: Path  # what `simrecon reconstruct` is given: a video file or a folder of images
    ground_truth: Path | None
    truth: Truth
    labels: Path | None = None  # outlines drawn by hand, CONTRACT section 5

    def digest(self) -> str:
        """Digest what goes into the figures: the input, cameras and entities of the truth, and the labels."""
        digest = hashlib.sha256(digest_input(self.source).encode())
        if self.ground_truth:
            for name in ("scene.json", "cameras.json"):
                file = self.ground_truth / name
                if file.is_file():
                    digest.update(name.encode() + b"\0" + file.read_bytes())
            # Meshes and images of the truth by name and size: reading them all takes long.
            for file in sorted(p for p in self.ground_truth.rglob("*") if p.is_file()):
                digest.update(f"{file.relative_to(self.ground_truth)} {file.stat().st_size}\n".encode())
        if self.labels:
            digest.update(b"labels\0" + self.labels.read_bytes())
        return digest.hexdigest()[:16]


def find_captures(folders: Sequence[Path], only: Sequence[str] = ()) -> list[Capture]:
    """Find the captures in folders, each of which is a capture or holds captures one level down.

    Args:
        folders: where to look, in order.
        only: names of captures to keep; all where empty.

    Returns:
        The captures by folder, then by name; two of the same name are told apart by their parent's name.

    Raises:
        UsageError: a folder does not exist or holds no capture, or a name in `only` is not there.
    """
    places: list[Path] = []
    for folder in folders:
        if not folder.is_dir():
            raise UsageError(f"--captures {folder}: no such folder")
        inside = (
            [folder] if _source(folder) else sorted(p for p in folder.iterdir() if p.is_dir() and _source(p))
        )
        if not inside:
            raise UsageError(
                f"--captures {folder}: no capture in it. A capture is a folder with video.mp4, or with images "
                f"(jpg, png) directly or in images/; ground_truth/ may lie beside them."
            )
        places += [place.resolve() for place in inside if place.resolve() not in places]
    names = [place.name for place in places]
    captures = [
        _capture(place, place.name if names.count(place.name) == 1 else f"{place.parent.name}_{place.name}")
        for place in places
    ]
    unknown = set(only) - {capture.name for capture in captures}
    if unknown:
        there = ", ".join(capture.name for capture in captures)
        raise UsageError(f"--only {' '.join(sorted(unknown))}: no such capture; there are {there}")
    return [capture for capture in captures if not only or capture.name in only]


def _source(folder: Path) -> Path | None:
    """Return what to reconstruct in a capture's folder, None where it is no capture."""
    if (folder / "video.mp4").is_file():
        return folder / "video.mp4"
    for place in (folder / "images", folder):
        if place.is_dir() and sum(p.suffix.lower() in _IMAGE_SUFFIXES for p in place.iterdir()) >= 2:
            return place
    return None


def _capture(folder: Path, name: str) -> Capture:
    source = _source(folder)
    assert source is not None
    truth_folder = folder / "ground_truth"
    beside = folder.parent / "labels" / f"{folder.name}.json"
    labels = beside if beside.is_file() else None
    for truth, file in (("scene", "scene.json"), ("cameras", "cameras.json")):
        if (truth_folder / file).is_file():
            return Capture(name, source, truth_folder, truth, labels)
    return Capture(name, source, None, "none", labels)
