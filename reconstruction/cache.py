"""Stage cache: results of finished stages on disk, each under the fingerprint of its inputs.

The fingerprint is the SHA-256 over the stage's name, its code (`code_digest`), its options, and the fingerprints of
the stages that it reads (for the first stage: the digest of the input). A result is a folder
`<work>/<NN>_<stage>-<fingerprint>/`. It is written under a temporary name and renamed when complete, so that a killed
run leaves no incomplete result. The last two results of each stage are kept by default.
"""

import dataclasses
import hashlib
import json
import logging
import os
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeVar

from reconstruction.core import artifacts
from registry.errors import EnvironmentMissing
from registry.files import write_whole

logger = logging.getLogger(__name__)
T = TypeVar("T")
KEPT_PER_STAGE = 2
_NEEDED_BYTES = 3 << 29  # the results of one video take about 1.5 GB
_MANIFEST = "manifest.json"


def canonical_json(value: Any) -> str:
    """Return dataclasses and plain values as JSON; equal values give equal text."""

    def default(item: Any) -> Any:
        if dataclasses.is_dataclass(item) and not isinstance(item, type):
            return dataclasses.asdict(item)
        if isinstance(item, Path):
            return str(item)
        raise TypeError(f"a config may not hold a {type(item).__name__}")

    return json.dumps(value, sort_keys=True, default=default, separators=(",", ":"), allow_nan=False)


def fingerprint(stage: str, code: Sequence[str], inputs: Any, upstream: tuple[str, ...]) -> str:
    """Return the fingerprint of a stage: 16 hex digits of the SHA-256 over all that its result depends on.

    Args:
        stage: its name.
        code: digests of its code (`code_digest`).
        inputs: its options and further inputs: dataclasses and plain values.
        upstream: fingerprints of the stages that it reads, or the digest of the input.
    """
    parts = [stage, *code, canonical_json(inputs), *upstream]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]


def digest_input(path: Path) -> str:
    """Return the SHA-256 of a file, or of the names and bytes of all files in a folder."""
    digest = hashlib.sha256()
    files = [path] if path.is_file() else sorted(p for p in path.rglob("*") if p.is_file())
    for file in files:
        if not path.is_file():
            digest.update(file.relative_to(path).as_posix().encode() + b"\0")
        with file.open("rb") as stream:
            for block in iter(lambda: stream.read(1 << 20), b""):
                digest.update(block)
    return digest.hexdigest()


class StageStore:
    """Results of finished stages of one input, on disk."""

    def __init__(self, work_dir: Path, kept_per_stage: int = KEPT_PER_STAGE) -> None:
        """Open or create the store, and remove temporary files of processes that ended early.

        Raises:
            EnvironmentMissing: the folder cannot be written, or the disk is full.
        """
        self.work_dir = work_dir
        self.kept_per_stage = kept_per_stage
        try:
            work_dir.mkdir(parents=True, exist_ok=True)
            self._sweep()
            free_bytes = shutil.disk_usage(work_dir).free
        except OSError as error:
            raise EnvironmentMissing(
                f"cannot write to the work folder {work_dir}: {error.strerror or error}. "
                f"Choose another with --work-dir."
            ) from error

        if free_bytes < _NEEDED_BYTES:
            raise EnvironmentMissing(
                f"{work_dir}: only {free_bytes / 2**30:.1f} GB free on this disk, a run needs about "
                f"{_NEEDED_BYTES / 2**30:.1f} GB. Free some, or choose another disk with --work-dir."
            )

    def _folder(self, number: int, stage: str, key: str) -> Path:
        return self.work_dir / f"{number:02d}_{stage}-{key}"

    def has(self, number: int, stage: str, key: str) -> bool:
        """Return whether a result with this fingerprint exists."""
        return (self._folder(number, stage, key) / _MANIFEST).is_file()

    def load(self, cls: type[T], number: int, stage: str, key: str) -> T:
        """Load a result and set its time of last use to now."""
        folder = self._folder(number, stage, key)
        os.utime(folder)
        return artifacts.load(cls, folder)

    def manifest(self, number: int, stage: str, key: str) -> dict:
        """Return the record of a result: time, memory, notes, config."""
        return json.loads((self._folder(number, stage, key) / _MANIFEST).read_text())

    def note_published(self, scene_id: str, revision: str, keys: dict[str, str]) -> None:
        """Record the fingerprints that a published scene was made from; an equal bundle may hold an older report."""
        path = self.work_dir / f"published-{scene_id}.json"
        write_whole(path, canonical_json({"revision": revision, "stage_keys": keys}).encode())

    def scratch(self, stage: str) -> Path:
        """Create an empty folder for temporary files of a stage; remove it with `discard`."""
        folder = self.work_dir / f"tmp-{os.getpid()}-{stage}-scratch"
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        return folder

    def discard(self, folder: Path) -> None:
        """Remove a folder of `scratch`."""
        shutil.rmtree(folder, ignore_errors=True)

    def save(self, value: Any, number: int, stage: str, key: str, record: dict) -> None:
        """Write a result atomically, then delete the stage's least recently used results beyond `kept_per_stage`.

        Raises:
            EnvironmentMissing: the disk is full or not writable.
        """
        target = self._folder(number, stage, key)
        partial = self.work_dir / f"tmp-{os.getpid()}-{stage}"
        shutil.rmtree(partial, ignore_errors=True)
        try:
            artifacts.save(value, partial)
            (partial / _MANIFEST).write_text(canonical_json(record))
            _sync_folder(partial)
            if target.exists():  # of another process, or damaged
                shutil.rmtree(target)
            partial.rename(target)
        except OSError as error:
            shutil.rmtree(partial, ignore_errors=True)
            raise EnvironmentMissing(
                f"{stage}: cannot write its result to {self.work_dir}: {error.strerror or error}. "
                f"Free some space or choose another disk with --work-dir; finished stages are kept."
            ) from error
        self._prune(number, stage, keep=target)

    def _prune(self, number: int, stage: str, keep: Path) -> None:
        siblings = [p for p in self.work_dir.glob(f"{number:02d}_{stage}-*") if p != keep]
        siblings.sort(key=lambda p: p.stat().st_mtime, reverse=True)
        for old in siblings[self.kept_per_stage - 1 :]:
            shutil.rmtree(old, ignore_errors=True)

    def _sweep(self) -> None:
        for leftover in self.work_dir.glob("tmp-*"):
            owner = leftover.name.split("-")[1]
            if not (owner.isdigit() and _is_alive(int(owner))):
                logger.info("removing %s, left by a run that ended early", leftover)
                if leftover.is_file():
                    leftover.unlink(missing_ok=True)
                shutil.rmtree(leftover, ignore_errors=True)


def _is_alive(pid: int) -> bool:
    if pid == os.getpid():
        return False
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass
    return True


def _sync_folder(folder: Path) -> None:
    for file in folder.iterdir():
        descriptor = os.open(file, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
