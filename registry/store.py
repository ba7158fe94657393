# pyright: strict
"""Registry of scenes: bundles in folders and an index beside them.

    <root>/index.sqlite                     one row per scene, with its current revision
    <root>/scenes/<scene id>/<revision>/    a bundle; the folder's name is the hash of its content
    <root>/locks/                           lock files, never deleted

Publishing is atomic: the staging folder is copied to `scenes/<id>/.publishing-…`, flushed to disk, verified and renamed
to its revision; the row is written last. An interrupted publish leaves only a `.publishing-…` folder. The scene's
publish lock is held while such a folder is in use, so the next publish of any scene removes those whose lock is free.

A new revision replaces the row, and older revisions are removed. A revision that a reader has open (`SceneBundle` holds
a shared lock on its folder) is removed at the next publish or removal of the scene.
"""

import contextlib
import errno
import os
import random
import re
import secrets
import shutil
from collections.abc import Generator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from registry.bundle import SceneBundle, seal_bundle
from registry.db import REPAIR, Index, SceneRow, StoredRows, utc_text
from registry.errors import (
    BundleError,
    EnvironmentMissing,
    SceneBusy,
    SceneNotFound,
    UsageError,
    did_you_mean,
)
from registry.index_rows import row_of_scene
from registry.locks import LockHeld, file_lock, is_leased, is_locked, scene_lock
from registry.roots import address_of, default_registry_root
from registry.schema import check_scene_id, is_scene_id
from registry.searching import revisions, search_folders

_TEMPORARY = (".publishing-", ".removing-")
_NUMBERED = re.compile(r"scene(\d{4,9})")
_MOST_SWEPT = 1000  # folders of other scenes that a publish looks into
_CAUSES = {
    errno.ENOSPC: "the disk is full",
    errno.EDQUOT: "the disk quota is used up",
    errno.EROFS: "the file system is read-only",
    errno.EACCES: "permission denied",
    errno.EPERM: "operation not permitted",
    errno.ENOTDIR: "a part of the path is a file, not a folder",
    errno.EEXIST: "a part of the path is a file, not a folder",
}


@dataclass(frozen=True)
class SceneRecord:
    """The index entry of a scene."""

    scene_id: str
    revision: str
    path: Path  # the bundle's folder
    schema_version: str
    created_utc: str
    source_file: str
    source_sha256: str
    n_objects: int
    status: str  # "stable" | "unstable" | "unchecked", from the bundle's own physics report
    metrics: dict[
        str, Any
    ]  # JSON values: scale method and uncertainty, counts, numbers of the physics report


@dataclass(frozen=True)
class VerifyReport:
    """Result of `SceneRegistry.verify`."""

    scene_id: str
    revision: str
    ok: bool
    problems: tuple[str, ...]
    files: int
    total_bytes: int


# `SceneRegistry.list` hides the built-in name inside the class, so annotations use these.
Records = list[SceneRecord]
Names = list[str]


class SceneRegistry:
    """All scenes below one folder. An absent registry reads as empty.

    `registry.open_registry` also opens those at an address; of these, this class would see the copy only.

    Raises:
        UsageError: The folder is the copy of a registry at an address.
    """

    def __init__(self, root: Path | None = None, create: bool = False) -> None:
        self.root = default_registry_root() if root is None else Path(root).expanduser()
        if type(self) is SceneRegistry and (address := address_of(self.root)) is not None:
            raise UsageError(f"{self.root} is a copy of {address}; open it by registry.open_registry")
        self.scenes_folder = self.root / "scenes"  # of the bundles
        self._index = Index(self.root / "index.sqlite")
        if create:
            with _disk_errors(f"create the registry {self.root}"):
                self.scenes_folder.mkdir(parents=True, exist_ok=True)
                self._create_index()

    @property
    def where(self) -> str:
        """Return the folder or the address of the registry, as `open_registry` takes it on any machine."""
        return str(self.root)

    def list(self) -> Records:
        """Return all scenes, ordered by id. Opens no bundle; scenes with a malformed row are left out.

        Raises:
            BundleError: The index is damaged, or is lost while there are scenes.
        """
        return self.list_with_problems()[0]

    def list_with_problems(self) -> tuple[Records, Names]:
        """Return all scenes as `list` does, and one line about each malformed row of the index."""
        self._check_links()
        rows, problems = self._index.read()
        if not rows and not problems:
            self._check_lost()
            rows, problems = self._index.read()
        return [self._record(row) for row in rows], problems

    def revisions(self, ordered: bool = True, known_only: bool = False) -> dict[str, str]:
        """Return {scene id: current revision} of all scenes; cheaper than `list`.

        Args:
            ordered: By scene id; otherwise in any order, which is faster.
            known_only: Of a registry at an address, return what was listed before, without asking there.

        Raises:
            BundleError: As `list`.
        """
        self._check_links()
        found = self._index.revisions(ordered)
        if not found:
            self._check_lost()
            found = self._index.revisions(ordered)
        return found

    def get(self, scene_id: str) -> SceneRecord:
        """Return the record of a scene.

        Raises:
            SceneNotFound: The scene does not exist; names the closest match and the existing scenes.
            BundleError: Its row of the index is malformed, or the index is damaged or lost.
        """
        check_scene_id(scene_id)
        self._check_links()
        row = self._index.row(scene_id)
        if row is None:
            self._check_lost()
            row = self._index.row(scene_id)
        if row is None:
            raise SceneNotFound(self._not_found(scene_id))
        return self._record(row)

    def load(self, scene_id: str, check_hashes: bool = False) -> SceneBundle:
        """Open the current revision of a scene."""
        while True:
            record = self.get(scene_id)
            try:
                return SceneBundle.open(record.path, check_hashes)
            except BundleError as error:
                # A newer revision may have been published since `get`: retry with it.
                if self.get(scene_id).revision == record.revision:
                    raise BundleError(
                        f"scene {scene_id}: {error}. Reconstruct it again, or `simrecon remove {scene_id}`"
                    ) from error

    def verify(self, scene_id: str) -> VerifyReport:
        """Check the schema of a scene, the size and hash of every file, and the agreement with the index."""
        record = self.get(scene_id)
        try:
            bundle = SceneBundle.open(record.path, check_hashes=True)
        except BundleError as error:
            return VerifyReport(scene_id, record.revision, False, (str(error),), 0, 0)
        problems: Names = []
        if bundle.revision != record.revision:
            problems.append(f"the index says revision {record.revision}, the bundle is {bundle.revision}")
        if bundle.scene["id"] != scene_id:
            problems.append(f"the bundle calls itself {bundle.scene['id']!r}")
        total = sum(size for _, size in bundle.files.values())
        return VerifyReport(
            scene_id, record.revision, not problems, tuple(problems), len(bundle.files), total
        )

    def next_free_id(self) -> str:
        """Return the next free `sceneNNNN`. If other processes may ask at the same time, use `reserve_next_id`."""
        return scene_name(self._highest_number() + 1)

    @contextlib.contextmanager
    def hold(self, scene_id: str) -> Generator[None, None, None]:
        """Lock a scene while the block reconstructs it.

        Raises:
            SceneBusy: Another process holds the lock.
            EnvironmentMissing: The registry cannot be written.
        """
        path = self.lock_path(scene_id, "hold")
        with contextlib.ExitStack() as stack:
            try:
                with _disk_errors(f"lock scene {scene_id}"):
                    stack.enter_context(file_lock(path, blocking=False))
            except LockHeld as error:
                raise SceneBusy(
                    f"scene {scene_id}: another process is reconstructing it ({error.holder}, {path}); wait "
                    "for it to end, or choose another id with --scene"
                ) from None
            yield

    @contextlib.contextmanager
    def reserve_next_id(self) -> Generator[str, None, None]:
        """Choose the next free id and lock it while the block runs; no two processes get the same id."""
        number = self._highest_number() + 1
        while True:
            scene_id = scene_name(number)
            with contextlib.ExitStack() as stack:
                try:
                    stack.enter_context(self.hold(scene_id))
                except SceneBusy:
                    number += 1
                    continue
                # The previous holder may have published it since.
                if self._index.row(scene_id) is not None:
                    number += 1
                    continue
                yield scene_id
                return

    def publish(self, staging: Path, scene_id: str) -> SceneRecord:
        """Publish a copy of a sealed bundle as the current revision of `scene_id`.

        A bundle sealed under another id gets this id. Publishing the current revision again changes nothing.

        Raises:
            BundleError: The staging folder is not a valid bundle.
            EnvironmentMissing: The registry cannot be written; no partial bundle remains.
        """
        check_scene_id(scene_id)
        SceneBundle.open(staging, check_hashes=False)  # before anything is created
        folder = self._scene_folder(scene_id)
        with _disk_errors(f"publish scene {scene_id} to {self.root}"):
            self._create_index()
            with file_lock(self.lock_path(scene_id, "publish")):
                self._sweep(folder)
                try:
                    folder.mkdir(parents=True, exist_ok=True)
                    row = self._place(Path(staging), folder, scene_id)
                finally:
                    with contextlib.suppress(OSError):
                        folder.rmdir()  # succeeds only if nothing was published
                self._remove_superseded(folder, row.revision)
            self._sweep_others(folder)
        return self._record(row)

    def remove(self, scene_id: str) -> None:
        """Remove a scene: its row first, then its files; never anything outside `scenes/<scene id>/`.

        Raises:
            SceneNotFound: The scene does not exist.
            BundleError: The scene's folder is a symbolic link.
        """
        if not self._index.has(check_scene_id(scene_id)):
            self.get(scene_id)  # says why
        folder = self._scene_folder(scene_id)
        with (
            _disk_errors(f"remove scene {scene_id} from {self.root}"),
            file_lock(self.lock_path(scene_id, "publish")),
        ):
            self._index.delete(scene_id)
            for revision in revisions(folder):
                _remove_folder(revision)
            self._sweep(folder)
            with contextlib.suppress(OSError):
                folder.rmdir()

    def rebuild_index(self) -> Records:
        """Rebuild a lost or damaged index from the folders; return the scenes found.

        The current revision of the index is kept where its bundle is valid; otherwise the last written of several is
        current. Invalid folders are kept but not indexed. The rows change in one transaction. A scene that is published
        or removed meanwhile keeps its newer state, and readers see the old rows or the new ones.
        """
        return self.rebuild()[0]

    def rebuild(self) -> tuple[Records, Names]:
        """Rebuild the index as `rebuild_index` does; return the scenes, and one line about each folder left out."""
        self._check_links()
        with _disk_errors(f"rebuild the index of {self.root}"):
            self.scenes_folder.mkdir(parents=True, exist_ok=True)
            before = self._index.stored()
            found, problems = self._rows_from_folders(before or {})
            self._index.merge(before, found)
        return [self._record(row) for row in self._index.rows()], problems

    # ---- Reading.

    def _record(self, row: SceneRow) -> SceneRecord:
        path = self.scenes_folder / f"{row.scene_id}/{row.revision}"  # one join, as joins are slow
        return SceneRecord(path=path, **vars(row))

    def _not_found(self, scene_id: str) -> str:
        known = self._known_ids()
        if not known:
            hint = "the registry is empty; make a scene with `simrecon reconstruct VIDEO`"
            return f"scene {scene_id!r} is not in {self.where}: {hint}"
        shown = ", ".join(known[:10]) + (f" and {len(known) - 10} more" if len(known) > 10 else "")
        return f"scene {scene_id!r} is not in {self.where}.{did_you_mean(scene_id, known)} There are: {shown}"

    def _known_ids(self) -> Names:
        return list(self._index.revisions())

    def _folder_ids(self) -> Names:
        with contextlib.suppress(FileNotFoundError, NotADirectoryError):
            folders = (f for f in sorted(self.scenes_folder.iterdir()) if is_scene_id(f.name))
            return [f.name for f in folders if any(revisions(f))]
        return []

    def _lost_ids(self) -> Names:
        """Return the scenes with folders, without those that are being published for the first time."""
        return [key for key in self._folder_ids() if not is_locked(self.lock_path(key, "publish"))]

    def _check_lost(self) -> None:
        """Raise BundleError if the index has no row while there are scenes; the caller found no row.

        A publisher writes its row before it releases its lock: the index is asked again after the locks.
        """
        if not self._index.is_empty():
            return
        lost = self._lost_ids()
        if lost and self._index.is_empty():
            shown = ", ".join(lost[:5]) + (f" and {len(lost) - 5} more" if len(lost) > 5 else "")
            what = "is empty" if self._index.exists() else "is lost"
            raise BundleError(
                f"registry: the index {self._index.path} {what}, but there are scenes in {self.scenes_folder}: "
                f"{shown}; {REPAIR}"
            )

    def _check_links(self) -> None:
        """Raise BundleError if a folder of the registry is a symbolic link: it could lead to anything."""
        for name in ("scenes", "locks"):
            if (self.root / name).is_symlink():
                raise BundleError(
                    f"registry: {self.root / name} is a symbolic link; a registry holds its own folders. Put a real "
                    "folder there, or choose another registry with --registry"
                )

    def _scene_folder(self, scene_id: str) -> Path:
        """Return the folder of a scene, which is no link."""
        self._check_links()
        folder = self.scenes_folder / check_scene_id(scene_id)
        if folder.is_symlink():
            raise BundleError(f"scene {scene_id}: its folder {folder} is a symbolic link; remove the link")
        return folder

    def _highest_number(self) -> int:
        """Return the highest number of the ids `sceneNNNN`, also of those whose row is not written yet."""
        highest = highest_number(self._known_ids())
        with contextlib.suppress(FileNotFoundError, NotADirectoryError):
            for folder in self.scenes_folder.iterdir():
                number = highest_number([folder.name])
                if number > highest and any(revisions(folder)):
                    highest = number
        return highest

    # ---- Writing.

    def lock_path(self, scene_id: str, purpose: str) -> Path:
        """Return the lock file of a scene for "publish" or "hold"."""
        return scene_lock(self.root, check_scene_id(scene_id), purpose)

    def _create_index(self) -> None:
        """Create the index; rebuild it from the folders if it was lost or emptied."""
        if self._index.is_empty() and self._lost_ids():
            self.rebuild_index()
        self._index.create()

    def _place(self, staging: Path, folder: Path, scene_id: str) -> SceneRow:
        temporary = folder / f"{_TEMPORARY[0]}{os.getpid()}-{secrets.token_hex(4)}"
        placed = None
        try:
            for name in [*SceneBundle.open(staging, check_hashes=False).files, "manifest.json"]:
                (temporary / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(staging / name, temporary / name)
            bundle = SceneBundle.open(temporary, check_hashes=True)
            if bundle.scene["id"] != scene_id:
                seal_bundle(temporary, {**bundle.scene, "id": scene_id})
                bundle = SceneBundle.open(temporary, check_hashes=True)
            final = folder / bundle.revision
            if final.exists() and not _is_intact(final):
                _remove_folder(final)
            if not final.exists():
                _flush_tree(temporary)
                temporary.replace(final)
                placed = final
                _flush(folder)
            row = self._valid_row(scene_id)
            # A new folder always gets its row: a rebuild of the index may have missed it.
            if row is None or row.revision != bundle.revision or placed is not None:
                same = row is not None and row.revision == bundle.revision
                created = row.created_utc if row is not None and same else utc_text()
                scene = SceneBundle.open(final, check_hashes=False).scene
                row = row_of_scene(scene, bundle.revision, scene_id, created)
                self._index.put(row)
            return row
        except BaseException:
            if placed is not None:
                shutil.rmtree(placed, ignore_errors=True)
            raise
        finally:
            shutil.rmtree(temporary, ignore_errors=True)

    def _valid_row(self, scene_id: str) -> SceneRow | None:
        try:
            return self._index.row(scene_id)
        except BundleError:  # malformed: it is written anew
            return None

    def _remove_superseded(self, folder: Path, current: str) -> None:
        for revision in revisions(folder):
            if revision.name != current and not is_leased(revision):
                _remove_folder(revision)

    def _sweep(self, folder: Path) -> None:
        """Remove temporary folders of dead processes; the caller holds the scene's publish lock."""
        if folder.is_dir() and not folder.is_symlink():
            for item in folder.iterdir():
                if item.name.startswith(_TEMPORARY):
                    shutil.rmtree(item, ignore_errors=True)

    def _sweep_others(self, but: Path) -> None:
        """Sweep other scenes' folders: all, or in a large registry a random part, so that the time is bounded."""
        folders = list(self.scenes_folder.iterdir())
        for folder in random.sample(folders, min(len(folders), _MOST_SWEPT)):
            if folder == but or folder.is_symlink() or not folder.is_dir():
                continue
            with contextlib.suppress(OSError):
                if not any(i.name.startswith(_TEMPORARY) for i in folder.iterdir()):
                    continue
            # Skip folders in use by another process (LockHeld) and folders that are no scenes (UsageError).
            with (
                contextlib.suppress(LockHeld, UsageError),
                file_lock(self.lock_path(folder.name, "publish"), blocking=False),
            ):
                self._sweep(folder)
                with contextlib.suppress(OSError):
                    folder.rmdir()

    def _rows_from_folders(self, before: StoredRows) -> tuple[dict[str, SceneRow], Names]:
        names: Names = []
        with contextlib.suppress(FileNotFoundError, NotADirectoryError):
            names = sorted(folder.name for folder in self.scenes_folder.iterdir() if is_scene_id(folder.name))
        return search_folders(self.root, names, before)


@contextlib.contextmanager
def _disk_errors(doing: str) -> Generator[None, None, None]:
    """Convert OSError into EnvironmentMissing with advice."""
    try:
        yield
    except OSError as error:
        cause = _CAUSES.get(error.errno or 0, error.strerror or str(error))
        where = f" ({error.filename})" if error.filename else ""
        raise EnvironmentMissing(
            f"registry: cannot {doing}: {cause}{where}. Free some space or fix the permissions, or choose "
            "another folder with --registry or $SIMRECON_HOME; nothing was published"
        ) from error


def highest_number(scene_ids: Names) -> int:
    """Return the highest number of the ids that are `sceneNNNN`; 0 if there are none."""
    return max((int(m[1]) for name in scene_ids if (m := _NUMBERED.fullmatch(name))), default=0)


def scene_name(number: int) -> str:
    """Return the id `sceneNNNN` of a number."""
    return f"scene{number:04d}"


def _is_intact(folder: Path) -> bool:
    try:
        return SceneBundle.open(folder, check_hashes=True).revision == folder.name
    except BundleError:
        return False


def _remove_folder(folder: Path) -> None:
    """Remove a revision: rename it first, so that it disappears in one step."""
    doomed = folder.with_name(f"{_TEMPORARY[1]}{folder.name}-{secrets.token_hex(4)}")
    folder.replace(doomed)
    shutil.rmtree(doomed, ignore_errors=True)


def _flush(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _flush_tree(folder: Path) -> None:
    for parent, _, names in os.walk(folder):
        for name in names:
            _flush(Path(parent, name))
        _flush(Path(parent))
