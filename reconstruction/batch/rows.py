"""A row of a batch: one video with its options, as arguments of `simrecon reconstruct` and as a fingerprint."""

import hashlib
import json
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

from registry.errors import UsageError

if TYPE_CHECKING:
    from upath import UPath

AnyPath: TypeAlias = "Path | UPath"  # a path object of universal_pathlib is of an address


@dataclass(frozen=True)
class VideoRow:
    """One video and its options. Paths are absolute."""

    scene_id: str
    video: AnyPath  # a file, or a folder of images
    preset: str = "default"
    options: tuple[str, ...] = ()  # of --set, each `stage.field=value`
    marker_size_m: float | None = None
    scale: str | None = None
    poses: Path | None = None
    overrides: Path | None = None
    seed: int = 0
    where: str = field(default="", compare=False)  # place in the list, for messages

    def arguments(self) -> list[str]:
        """Return the arguments of `simrecon reconstruct` that this row sets."""
        found = [str(self.video), "--scene", self.scene_id, "--preset", self.preset]
        for option in self.options:
            found += ["--set", option]
        if self.marker_size_m is not None:
            found += ["--marker-size", repr(self.marker_size_m)]
        for flag, value in (
            ("--scale", self.scale),
            ("--poses", self.poses),
            ("--overrides", self.overrides),
        ):
            if value is not None:
                found += [flag, str(value)]
        return found + (["--seed", str(self.seed)] if self.seed else [])

    def fingerprint(self, common: tuple[str, ...] = ()) -> str:
        """Return 16 hex digits of the SHA-256 over the options and the state of the input files.

        Of the video, names, sizes and times of change count, not the bytes; of the overrides, the bytes.

        Args:
            common: arguments that all rows share and that change results.
        """
        said = {
            "arguments": [*self.arguments(), *common],
            "video": _state(self.video),
            "poses": None if self.poses is None else _state(self.poses),
            "overrides": None
            if self.overrides is None
            else hashlib.sha256(self.overrides.read_bytes()).hexdigest(),
        }
        return hashlib.sha256(json.dumps(said, sort_keys=True).encode()).hexdigest()[:16]


def size_bytes(path: AnyPath) -> int:
    """Return the size of a file, or of all files in a folder."""
    return sum(size for _, size, _ in _state(path))


def check_there(path: AnyPath) -> None:
    """Raise unless there is such a video.

    Raises:
        UsageError: there is none.
        EnvironmentMissing: its address cannot be reached.
    """
    if not isinstance(path, Path):
        _remote_state(path)
    elif not path.exists():
        raise UsageError(f"{path}: no such file or folder")


def _state(path: AnyPath) -> list[tuple[str, int, int | str]]:
    """Return (name, bytes, time of change in ns or version) of a file, or of each file below a folder."""
    if not isinstance(path, Path):
        return _remote_state(path)
    files = [path] if not path.is_dir() else sorted(p for p in path.rglob("*") if p.is_file())
    stats = [(file, file.stat()) for file in files]
    return [(file.relative_to(path.parent).as_posix(), s.st_size, s.st_mtime_ns) for file, s in stats]


@cache
def _remote_state(path: "UPath") -> list[tuple[str, int, int | str]]:
    """Ask for the state of a video at an address, once in a command."""
    from reconstruction.downloads import files_of

    return list(files_of(path))
