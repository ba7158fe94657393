"""Stage cache: results of finished stages on disk, each under the fingerprint of its inputs.

The fingerprint is the SHA-256 over the stage's name, its code (`code_digest`), its options, and the fingerprints of
the stages that it reads (for the first stage: the digest of the input). A result is a folder
`<work>/<NN>_<stage>-<fingerprint>/`. It is written under a temporary name and renamed when complete, so that a killed
run leaves no incomplete result. Its manifest lists a digest of every file. The last two results of each stage are kept
by default. Runs may share a work folder: the first finished result of a fingerprint stays, and the result of a stage
that a run has found or saved last is leased, so that no other run removes it.
"""

import contextlib
import dataclasses
import errno
import hashlib
import json
import logging
import os
import secrets
import shutil
import time
import weakref
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

from reconstruction.core import artifacts
from reconstruction.leases import Leases, remove_at_once, remove_unless_leased
from registry.errors import BundleError, EnvironmentMissing
from registry.files import write_whole

logger = logging.getLogger(__name__)
T = TypeVar("T")
KEPT_PER_STAGE = 2
_NEEDED_BYTES = 3 << 29  # the results of one video take about 1.5 GB
_MANIFEST = "manifest.json"
_WHOLE_BELOW_BYTES = 4 << 20  # larger files are sampled by `quick_digest`
_SAMPLES, _SAMPLE_BYTES = 64, 1 << 16
_TRIES = 10  # to put a result in place while other runs do the same
_WAIT_S = 0.01  # after the first of them, then twice as long each time
_NO_SPACE = (errno.ENOSPC, errno.EDQUOT)
_UNREADABLE = (BundleError, ValueError, TypeError, LookupError, AttributeError, EOFError, RecursionError)


class DamagedResult(EnvironmentMissing):
    """A result in the work folder cannot be read, or is not what was written."""


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
            digest.update(os.fsencode(file.relative_to(path).as_posix()) + b"\0")
        with file.open("rb") as stream:
            for block in iter(lambda: stream.read(1 << 20), b""):
                digest.update(block)
    return digest.hexdigest()


def quick_digest(path: Path) -> str:
    """Return the SHA-256 of a file's size and bytes; of files above 4 MB, of 64 blocks of 64 kB at equal distances.

    The samples show a file that was cut, or lost whole blocks; they do not show every changed byte.
    """
    with path.open("rb") as stream:
        size = os.fstat(stream.fileno()).st_size
        digest = hashlib.sha256(f"{size}\n".encode())
        if size <= _WHOLE_BELOW_BYTES:
            digest.update(stream.read())
        else:
            for sample in range(_SAMPLES):
                stream.seek((size - _SAMPLE_BYTES) * sample // (_SAMPLES - 1))
                digest.update(stream.read(_SAMPLE_BYTES))
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
        self._leases = Leases()
        weakref.finalize(self, self._leases.release_all)
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

    def __enter__(self) -> "StageStore":
        """Use it for a run."""
        return self

    def __exit__(self, *exc: object) -> None:
        """End its use; results in other places are complete then."""

    def _folder(self, number: int, stage: str, key: str) -> Path:
        return self.work_dir / f"{number:02d}_{stage}-{key}"

    def _temporary(self, stage: str) -> Path:
        """Create an empty folder that no other run removes while this process lives."""
        folder = self.work_dir / f"tmp-{os.getpid()}-{stage}-{secrets.token_hex(4)}"
        folder.mkdir(parents=True)
        self._leases.take(folder.name, folder)
        return folder

    def has(self, number: int, stage: str, key: str) -> bool:
        """Return whether a result with this fingerprint exists; if so, other runs keep it while this one uses it."""
        return self._is_here(number, stage, key)

    def _is_here(self, number: int, stage: str, key: str) -> bool:
        """As `has`, on this disk."""
        folder = self._folder(number, stage, key)
        if not (folder / _MANIFEST).is_file() or not self._leases.take(stage, folder):
            return False
        return (folder / _MANIFEST).is_file()

    def check(self, number: int, stage: str, key: str) -> None:
        """Compare all files of a result with the sizes and digests in its manifest.

        Raises:
            DamagedResult: a file is missing or not as it was written.
        """
        folder = self._folder(number, stage, key)
        with _reading(folder):
            for name, digest in json.loads((folder / _MANIFEST).read_text()).get("files", {}).items():
                if quick_digest(folder / name) != digest:
                    raise DamagedResult(f"{folder / name} is not as it was written")

    def load(self, cls: type[T], number: int, stage: str, key: str) -> T:
        """Load a result and set its time of last use to now.

        Raises:
            DamagedResult: it cannot be read.
        """
        folder = self._folder(number, stage, key)
        with _reading(folder), contextlib.suppress(PermissionError):  # of another user
            os.utime(folder)
        return read_result(cls, folder)

    def manifest(self, number: int, stage: str, key: str) -> dict:
        """Return the record of a result: time, memory, notes, config.

        Raises:
            DamagedResult: it cannot be read.
        """
        folder = self._folder(number, stage, key)
        with _reading(folder):
            record = json.loads((folder / _MANIFEST).read_text())
            if not isinstance(record, dict):
                raise DamagedResult(f"{folder / _MANIFEST} is not as it was written")
            return {name: value for name, value in record.items() if name != "files"}

    def remove(self, number: int, stage: str, key: str) -> None:
        """Remove a damaged result, so that it can be computed again.

        Raises:
            EnvironmentMissing: the folder may not be changed.
        """
        self._leases.release(stage)
        folder = self._folder(number, stage, key)
        if not remove_at_once(folder):
            raise EnvironmentMissing(
                f"{folder} is damaged and cannot be removed. Remove it, or choose another folder with --work-dir."
            )

    def note_published(self, scene_id: str, revision: str, keys: dict[str, str]) -> None:
        """Record the fingerprints that a published scene was made from; an equal bundle may hold an older report."""
        path = self.work_dir / f"published-{scene_id}.json"
        write_whole(path, canonical_json({"revision": revision, "stage_keys": keys}).encode())

    def scratch(self, stage: str) -> Path:
        """Create an empty folder for temporary files of a stage; remove it with `discard`."""
        return self._temporary(f"{stage}-scratch")

    def discard(self, folder: Path) -> None:
        """Remove a folder of `scratch`."""
        self._leases.release(folder.name)
        shutil.rmtree(folder, ignore_errors=True)

    def save(self, value: Any, number: int, stage: str, key: str, record: dict) -> None:
        """Write a result atomically, then delete the stage's least recently used results beyond `kept_per_stage`.

        An intact result of the same fingerprint, of another run, is kept. Results in use by other runs are not deleted.

        Raises:
            EnvironmentMissing: the disk is full or not writable.
        """
        target = self._folder(number, stage, key)
        partial = None
        try:
            partial = self._temporary(stage)
            artifacts.save(value, partial)
            files = {file.name: quick_digest(file) for file in sorted(partial.iterdir())}
            (partial / _MANIFEST).write_text(canonical_json({**record, "files": files}))
            _sync_folder(partial)
            self._put(partial, number, stage, key)
        except OSError as error:
            raise _write_error(error, stage, self.work_dir) from error
        finally:
            if partial is not None:
                self.discard(partial)
        self._prune(number, stage, keep=target)

    def _put(self, partial: Path, number: int, stage: str, key: str) -> None:
        """Rename a complete result to its name, unless another run's intact one is there; lease the one that stays."""
        target = self._folder(number, stage, key)
        for attempt in range(_TRIES):
            if attempt:  # another run may be about to remove what is there
                time.sleep(_WAIT_S * 2 ** (attempt - 1))
            if self._is_here(number, stage, key):
                try:
                    self.check(number, stage, key)
                    return
                except DamagedResult:
                    self.remove(number, stage, key)
            # Not one that another run has put there meanwhile: that has a manifest, and the next try finds it.
            elif target.exists() and not (target / _MANIFEST).is_file():
                (remove_unless_leased if target.is_dir() else remove_at_once)(target)
            try:
                partial.rename(target)
            except (FileExistsError, NotADirectoryError):
                continue
            except OSError as error:
                if error.errno != errno.ENOTEMPTY:
                    raise
                continue
            if self._leases.take(stage, target):
                return
            raise FileNotFoundError(errno.ENOENT, "another process removes results from it", str(target))
        raise FileExistsError(errno.EEXIST, "another process writes there", str(target))

    def _prune(self, number: int, stage: str, keep: Path) -> None:
        siblings = []
        for path in self.work_dir.glob(f"{number:02d}_{stage}-*"):
            with contextlib.suppress(FileNotFoundError):  # another run has pruned it
                if path != keep:
                    siblings.append((path.stat().st_mtime, path))
        siblings.sort(reverse=True)
        for _, old in siblings[self.kept_per_stage - 1 :]:
            remove_unless_leased(old)

    def _sweep(self) -> None:
        for leftover in self.work_dir.glob("tmp-*"):
            owner = leftover.name.split("-")[1]
            if owner.isdigit() and _is_alive(int(owner)):
                continue
            if leftover.is_file():
                leftover.unlink(missing_ok=True)
            elif remove_unless_leased(leftover):
                logger.info("removed %s, left by a run that ended early", leftover)


def read_result(cls: type[T], folder: Path) -> T:
    """Load the artifact in the folder of a result.

    Raises:
        DamagedResult: it cannot be read.
        EnvironmentMissing: it may not be read.
    """
    with _reading(folder):
        return artifacts.load(cls, folder)


@contextlib.contextmanager
def _reading(folder: Path) -> Iterator[None]:
    """Turn errors of reading a result into `DamagedResult`, a missing permission into `EnvironmentMissing`."""
    try:
        yield
    except PermissionError as error:
        raise EnvironmentMissing(
            f"cannot read {error.filename or folder}: {error.strerror}. Fix its permissions, or choose another folder "
            "with --work-dir."
        ) from error
    except OSError as error:
        raise DamagedResult(f"{error.filename or folder}: {error.strerror or error}") from error
    except _UNREADABLE as error:
        raise DamagedResult(f"{folder}: {error}") from error


def _write_error(error: OSError, stage: str, work_dir: Path) -> EnvironmentMissing:
    advice = "Free some space" if error.errno in _NO_SPACE else "Fix its permissions"
    return EnvironmentMissing(
        f"{stage}: cannot write its result to {work_dir}: {error.strerror or error}. {advice} or choose another disk "
        "with --work-dir; finished stages are kept."
    )


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
