# pyright: strict
"""Search the folders of a registry for its scenes.

More than `_CHUNK` scenes are searched by processes of their own: most of the time is spent in checks and in waiting for
the disk. A process takes a part of the scenes from its standard input. It inherits no lock, and ends by itself if the
process that started it is killed.
"""

import contextlib
import json
import pickle
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

from registry.bundle import SceneBundle
from registry.db import StoredRows, utc_text
from registry.errors import BundleError, EnvironmentMissing, SimReconError
from registry.index_rows import SceneRow, is_revision, row_of, row_of_scene
from registry.locks import file_lock, scene_lock

_CHUNK = 1000  # scenes
_PROCESSES = 8  # more than cores, as they wait for the disk
_CODE = "import json, sys; sys.path[:] = json.loads(sys.argv[1]); from registry.searching import main; main()"
Found: TypeAlias = tuple[dict[str, SceneRow], list[str]]


def revisions(folder: Path) -> Iterator[Path]:
    """Yield the folders of a scene's revisions, ordered by name."""
    if folder.is_symlink():
        return
    with contextlib.suppress(FileNotFoundError, NotADirectoryError):
        for item in sorted(folder.iterdir()):
            if is_revision(item.name) and item.is_dir() and not item.is_symlink():
                yield item


def search_folders(root: Path, scene_ids: list[str], before: StoredRows) -> Found:
    """Return a row for each scene with a valid bundle, and one line about each bundle that is not; reads every file.

    Args:
        root: Folder of the registry.
        scene_ids: Names of folders of scenes.
        before: Rows of the index, which say the current revisions.
    """
    if len(scene_ids) <= _CHUNK:
        return _search(root, scene_ids, before)
    parts = [scene_ids[i : i + _CHUNK] for i in range(0, len(scene_ids), _CHUNK)]
    rows: dict[str, SceneRow] = {}
    problems: list[str] = []
    with ThreadPoolExecutor(_PROCESSES) as pool:
        for found, said in pool.map(partial(_search_by_process, root, before), parts):
            rows |= found
            problems += said
    return rows, problems


def main() -> None:
    """Search the folders that standard input names; write what was found, or the error, to standard output."""
    try:
        result = _search(*pickle.load(sys.stdin.buffer))
    except (SimReconError, OSError) as error:
        result = error
    pickle.dump(result, sys.stdout.buffer)


def _search_by_process(root: Path, before: StoredRows, scene_ids: list[str]) -> Found:
    known = {key: before[key] for key in scene_ids if key in before}
    done = subprocess.run(
        [sys.executable, "-I", "-c", _CODE, json.dumps([*map(str, sys.path)])],
        input=pickle.dumps((root, scene_ids, known)),
        capture_output=True,
        check=False,
    )
    if done.returncode:
        said = done.stderr.decode("utf-8", "replace").strip().rpartition("\n")[2]
        raise EnvironmentMissing(
            f"registry: a process that checks scenes ended with code {done.returncode} ({said}); run it again"
        )
    result = pickle.loads(done.stdout)
    if isinstance(result, Exception):
        raise result
    return result


def _search(root: Path, scene_ids: list[str], before: StoredRows) -> Found:
    rows: dict[str, SceneRow] = {}
    problems: list[str] = []
    for scene_id in scene_ids:
        folder = root / "scenes" / scene_id
        if not any(revisions(folder)):
            continue
        with file_lock(scene_lock(root, scene_id, "publish")):  # see no half of a publication
            row, said = _search_scene(folder, before.get(scene_id))
        problems += said
        if row is not None:
            rows[scene_id] = row
    return rows, problems


def _search_scene(folder: Path, stored: tuple[Any, ...] | None) -> tuple[SceneRow | None, list[str]]:
    current = None
    if stored is not None:
        with contextlib.suppress(BundleError):
            current = row_of(stored)
    found: list[tuple[bool, float, SceneRow]] = []
    problems: list[str] = []
    for revision in revisions(folder):
        try:
            bundle = SceneBundle.open(revision, check_hashes=True)
            written = (revision / "manifest.json").stat().st_mtime
            if bundle.revision != revision.name or bundle.scene["id"] != folder.name:
                raise BundleError(f"bundle {revision}: it belongs to another scene or revision")
        except BundleError as error:
            problems.append(f"scene {folder.name}: {error}")
            continue
        is_current = current is not None and current.revision == revision.name
        created = current.created_utc if current is not None and is_current else utc_text(written)
        row = row_of_scene(bundle.scene, bundle.revision, folder.name, created)
        found.append((is_current, written, row))
    best = max(found, key=lambda item: (*item[:2], item[2].revision), default=None)
    return None if best is None else best[2], problems
