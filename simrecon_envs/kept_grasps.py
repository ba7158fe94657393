"""Grasps on disk: those of a scene's objects for one hand, so that only the first process of a machine searches them.

One JSON file a scene, hand and version of the search, in `$SIMRECON_HOME/cache/grasps`. A file that cannot be read is
searched anew; where nothing can be written, every process searches.
"""

import contextlib
import hashlib
import json
import os
from collections.abc import Callable
from dataclasses import asdict, astuple
from functools import cache
from pathlib import Path

import numpy as np

from registry.files import write_whole
from registry.roots import home_folder
from simrecon_envs import grasps, occupancy, surfaces
from simrecon_envs.grasps import Grasp
from simrecon_envs.robots import HandShape

_MOST_FILES = 2000  # the oldest half of more is deleted
_NUMBERS = 7  # of a grasp


class KeptGrasps:
    """The grasps of one scene's objects for one hand."""

    def __init__(self, revision: str, hand: HandShape) -> None:
        """Read the file of a scene's revision, if there is one."""
        what = json.dumps([revision, asdict(hand), _search_digest(), np.__version__])
        name = hashlib.sha256(what.encode()).hexdigest()[:24]
        self._file = _folder() / f"{name}.json"
        self._rows = _read(self._file)
        self._new = False

    def of(self, key: int, search: Callable[[], list[Grasp]]) -> list[Grasp]:
        """Return the grasps of an object, best first; `search` finds them if they are not kept."""
        if str(key) not in self._rows:
            found = [astuple(grasp) for grasp in search()]
            self._rows[str(key)] = [[*map(float, offset), *rest] for offset, *rest in found]
            self._new = True
        return [Grasp(np.array(row[:3]), *row[3:]) for row in self._rows[str(key)]]

    def save(self) -> None:
        """Write what was searched since, whole or not at all."""
        if not self._new:
            return
        with contextlib.suppress(OSError):
            self._file.parent.mkdir(parents=True, exist_ok=True)
            _drop_oldest(self._file.parent)
            write_whole(self._file, json.dumps(self._rows).encode())
        self._new = False


def _folder() -> Path:
    """Return the folder of all files; one that cannot be made where the user has no home."""
    try:
        return home_folder() / "cache" / "grasps"
    except RuntimeError:
        return Path(os.devnull) / "grasps"


def _read(file: Path) -> dict[str, list[list[float]]]:
    """Return the rows of a file; none if it is missing or damaged."""
    try:
        rows = json.loads(file.read_text())
        whole = all(len(np.asarray(row, float)) == _NUMBERS for found in rows.values() for row in found)
    except (OSError, ValueError, TypeError, AttributeError, RecursionError):
        return {}
    return rows if whole else {}


@cache
def _search_digest() -> str:
    """Return a digest of the code that grasps follow from."""
    files = [Path(str(module.__file__)) for module in (grasps, occupancy, surfaces)]
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()


def _drop_oldest(folder: Path) -> None:
    files = list(folder.glob("*.json"))
    if len(files) >= _MOST_FILES:
        for file in sorted(files, key=lambda f: f.stat().st_mtime)[: _MOST_FILES // 2]:
            file.unlink(missing_ok=True)
