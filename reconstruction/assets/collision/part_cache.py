"""Cache of collision parts, by mesh and options."""

import contextlib
import hashlib
import io
import json
import os
import zipfile
import zlib
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path

import numpy as np

from reconstruction.assets.collision.build import collision_parts
from reconstruction.assets.config import AssetsConfig
from reconstruction.assets.solid import Solid
from reconstruction.code_digest import code_digest
from reconstruction.core.progress import NoProgress, Progress
from reconstruction.core.types import ConvexPart
from reconstruction.learned.requesting import write_whole

_MOST_KEPT = 400  # files; the least recently used ones are deleted
_ELSEWHERE = (
    "texture_",
    "base_",
    "generator",
    "physics",
)  # prefixes of options that no collision shape depends on


def kept_parts(
    folder: Path, solid: Solid, config: AssetsConfig, *, levels: tuple[float, ...], progress: Progress, name: str
) -> tuple[ConvexPart, ...]:  # fmt: skip
    """Return `collision_parts` from a cache folder, or compute and cache them.

    Parts after a failure of CoACD are not cached, so that the next run tries again.
    """
    file = folder / f"{_digest(solid, config, levels)}.npz"
    kept = _read(file)
    if kept is not None:
        with contextlib.suppress(OSError):  # pruned by another run, or of another user
            os.utime(file)
        return kept
    watch = _Watch(progress)
    parts = collision_parts(solid, config, levels=levels, progress=watch, name=name)
    if not watch.heard:
        write_whole(file, _packed(parts))
        _forget_old(folder)
    return parts


class _Watch(NoProgress):
    """Forwards notes and remembers whether there were any."""

    def __init__(self, listener: Progress) -> None:
        self._listener, self.heard = listener, False

    def note(self, message: str) -> None:
        self.heard = True
        self._listener.note(message)


def _digest(solid: Solid, config: AssetsConfig, levels: tuple[float, ...]) -> str:
    options = {key: value for key, value in asdict(config).items() if not key.startswith(_ELSEWHERE)}
    code = code_digest("reconstruction.assets.collision")
    digest = hashlib.sha256(json.dumps([options, levels, code, version("coacd")]).encode())
    for array in (np.asarray(solid.vertices, np.float64), np.asarray(solid.faces, np.int32)):
        digest.update(str(array.shape).encode() + np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()[:32]


def _packed(parts: tuple[ConvexPart, ...]) -> bytes:
    arrays = {}
    for number, part in enumerate(parts):
        arrays[f"v{number}"], arrays[f"f{number}"] = part.vertices, part.faces
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return buffer.getvalue()


def _read(file: Path) -> tuple[ConvexPart, ...] | None:
    """Return kept parts; None where there are none, or the file is damaged."""
    try:
        with np.load(file, allow_pickle=False) as arrays:
            return tuple(ConvexPart(arrays[f"v{k}"], arrays[f"f{k}"]) for k in range(len(arrays.files) // 2))
    except (OSError, ValueError, LookupError, EOFError, RuntimeError, zipfile.BadZipFile, zlib.error):
        return None


def _forget_old(folder: Path) -> None:
    files = []
    for file in folder.glob("*.npz"):
        with contextlib.suppress(FileNotFoundError):  # pruned by another run
            files.append((file.stat().st_mtime, file))
    for _, file in sorted(files)[: max(len(files) - _MOST_KEPT, 0)]:
        file.unlink(missing_ok=True)
