"""Remote stage cache: results of finished stages at an fsspec address, so that any machine goes on from them.

The cache of this machine (`reconstruction.cache`) stays the one that stages read. A result that it lacks is downloaded;
a result that was computed is uploaded while the next stage runs, as one uncompressed tar file:

    <address>/<first 16 digits of the input's digest>/<NN>_<stage>-<fingerprint>.tar

An object store shows an object when its upload is complete, so a killed run leaves no incomplete result there. The last
results of each stage are kept, as on this machine.
"""

import logging
import tarfile
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

from reconstruction.cache import KEPT_PER_STAGE, DamagedResult, StageStore
from reconstruction.leases import remove_unless_leased
from registry.errors import SimReconError
from registry.exchange.place import Place, open_place
from registry.roots import is_address

logger = logging.getLogger(__name__)
T = TypeVar("T")
_SUFFIX = ".tar"
_OPENED = "opened"  # an empty object that shows that the address can be written
_MOST_BYTES = 1 << 36  # of one result
_DIGITS = 16


def work_folder(work_dir: Path | str | None, registry_root: Path, input_digest: str) -> Path:
    """Return the folder of the stage cache on this machine.

    Args:
        work_dir: value of `--work-dir`: a folder, an address, or None.
        registry_root: folder of the registry; the default caches lie beside it.
        input_digest: SHA-256 of the video.
    """
    if work_dir is None or is_address(work_dir):
        return registry_root.parent / "work" / input_digest[:_DIGITS]
    return Path(work_dir)


def open_store(
    work_dir: Path | str | None,
    registry_root: Path,
    input_digest: str,
    kept_per_stage: int = KEPT_PER_STAGE,
    note: Callable[[str], None] = logger.warning,
) -> StageStore:
    """Open the stage cache of a video.

    Args:
        work_dir: as of `work_folder`.
        registry_root: as of `work_folder`.
        input_digest: as of `work_folder`.
        kept_per_stage: number of results of each stage that stay, here and at the address.
        note: receives one line if the address fails later.

    Raises:
        EnvironmentMissing: the folder cannot be written.
        UsageError: there is no such protocol.
    """
    folder = work_folder(work_dir, registry_root, input_digest)
    if not is_address(work_dir):
        return StageStore(folder, kept_per_stage)
    return RemoteStageStore(folder, RemoteResults(str(work_dir), input_digest), kept_per_stage, note)


def drop_results(address: str, registry_root: Path, input_digest: str) -> None:
    """Delete the results of a video at an address, and those of its default work folder that no run uses.

    Raises:
        EnvironmentMissing: the address cannot be reached.
    """
    RemoteResults(address, input_digest).drop()
    folder = work_folder(address, registry_root, input_digest)
    for result in folder.glob("[0-9][0-9]_*-*"):
        remove_unless_leased(result)


class RemoteResults:
    """Results of one input at an address."""

    def __init__(self, address: str, input_digest: str) -> None:
        """Open the address; reaches no network."""
        self.place: Place = open_place(address)
        self.folder = input_digest[:_DIGITS]

    def open(self) -> set[str]:
        """Return the names of all results.

        Raises:
            UsageError: the bucket does not exist.
            EnvironmentMissing: the address cannot be reached or, unless it is read-only, written.
        """
        if not self.place.read_only:
            self.place.write(f"{self.folder}/{_OPENED}", b"")
        return set(self.names())

    def drop(self) -> None:
        """Delete everything; errors as of `open`."""
        self.remove(*self.names())
        self.place.remove([f"{self.folder}/{_OPENED}"])

    def names(self, prefix: str = "") -> list[str]:
        """Return the names of the results, such as `04_depth-0123456789abcdef`."""
        keys = self.place.keys(self.folder, prefix)
        return [key.removesuffix(_SUFFIX) for key in keys if key.startswith(prefix) and key.endswith(_SUFFIX)]

    def fetch(self, name: str, folder: Path) -> bool:
        """Download a result into an empty folder; return False if there is none.

        Raises:
            EnvironmentMissing: the address cannot be reached.
            DamagedResult: the archive is damaged, or holds more than plain files.
        """
        archive = folder / f"{name}{_SUFFIX}"
        try:
            self.place.fetch(self._key(name), archive, _MOST_BYTES)
        except FileNotFoundError:
            return False
        try:
            with tarfile.open(archive, "r:") as tar:
                if any(not member.isfile() or "/" in member.name for member in tar):
                    raise tarfile.TarError("it holds more than plain files")
                tar.extractall(folder, filter="data")
        except tarfile.TarError as error:
            raise DamagedResult(f"{self.place.url}/{self._key(name)}: no stage result: {error}") from error
        finally:
            archive.unlink(missing_ok=True)
        return True

    def send(self, folder: Path, archive: Path) -> None:
        """Upload the result in a folder; `archive` is a free name for a temporary file.

        Raises:
            SimReconError: the address cannot be reached or written.
            OSError: the temporary file cannot be written.
        """
        try:
            with tarfile.open(archive, "w:") as tar:
                for file in sorted(folder.iterdir()):
                    tar.add(file, file.name)
            self.place.upload(self._key(folder.name), archive)
        finally:
            archive.unlink(missing_ok=True)

    def remove(self, *names: str) -> None:
        """Delete results; absent ones are no error."""
        self.place.remove([self._key(name) for name in names])

    def prune(self, prefix: str, keep: str, kept: int) -> None:
        """Delete the results with a prefix that were written first, beyond `kept` of them; never `keep`."""
        names = [name for name in self.names(prefix) if name != keep]
        if len(names) >= kept:
            names.sort(key=lambda name: self.place.modified_s(self._key(name)))
            self.remove(*names[: len(names) - kept + 1])

    def _key(self, name: str) -> str:
        return f"{self.folder}/{name}{_SUFFIX}"


class RemoteStageStore(StageStore):
    """Stage cache on this machine, with a second copy at an address.

    If the address fails after it was opened, the run goes on without it, and says so when it ends.
    """

    def __init__(
        self, work_dir: Path, remote: RemoteResults, kept_per_stage: int, note: Callable[[str], None]
    ) -> None:
        """Open the folder, see `StageStore`; the address is opened when a run begins (`with`)."""
        super().__init__(work_dir, kept_per_stage)
        self._remote, self._note = remote, note
        self._there: set[str] = set()  # results at the address, and those on their way
        self._failure = ""
        self._uploads: list[Future[None]] = []
        self._uploader = ThreadPoolExecutor(1)

    def __enter__(self) -> "RemoteStageStore":
        """Open the address for a run.

        Raises:
            UsageError: the bucket does not exist.
            EnvironmentMissing: the address cannot be reached or written.
        """
        self._there = self._remote.open()
        return self

    def __exit__(self, kind: type[BaseException] | None, *rest: object) -> None:
        """Wait for the uploads; after Ctrl-C for the running one only."""
        self._uploader.shutdown(cancel_futures=kind is KeyboardInterrupt)
        if kind is None:
            for upload in self._uploads:
                upload.result()
        if self._failure:
            self._note(f"{self._failure}. The run went on without it: other machines lack its later results")

    def has(self, number: int, stage: str, key: str) -> bool:
        """Return whether a result with this fingerprint exists here or, after a download, came from the address."""
        return self._is_here(number, stage, key) or self._download(number, stage, key)

    def load(self, cls: type[T], number: int, stage: str, key: str) -> T:
        """Load a result; one that the address lacks is uploaded while the run goes on."""
        value = super().load(cls, number, stage, key)
        folder = self._folder(number, stage, key)
        lease = f"upload-{folder.name}"
        if self._sends and folder.name not in self._there and self._leases.take(lease, folder):
            self._there.add(folder.name)
            self._uploads.append(self._uploader.submit(self._upload, folder, f"{number:02d}_{stage}-", lease))
        return value

    def remove(self, number: int, stage: str, key: str) -> None:
        """Remove a damaged result, here and at the address."""
        super().remove(number, stage, key)
        name = self._folder(number, stage, key).name
        if self._sends and name in self._there:
            self._there.discard(name)
            with self._surviving():
                self._remote.remove(name)

    @property
    def _sends(self) -> bool:
        return not self._failure and not self._remote.place.read_only

    def _download(self, number: int, stage: str, key: str) -> bool:
        name = self._folder(number, stage, key).name
        if self._failure:
            return False
        partial = self._temporary(stage)
        try:
            with self._surviving():
                if self._remote.fetch(name, partial):
                    self._put(partial, number, stage, key)
                    self._there.add(name)
                    return True
        except DamagedResult as error:  # computed again, and uploaded in its place
            logger.info("%s", error)
            self._there.discard(name)
        finally:
            self.discard(partial)
        return False

    def _upload(self, folder: Path, prefix: str, lease: str) -> None:
        if self._failure:
            return
        scratch = self._temporary("upload")
        try:
            with self._surviving():
                self._remote.send(folder, scratch / "archive")
                self._remote.prune(prefix, folder.name, self.kept_per_stage)
        finally:
            self.discard(scratch)
            self._leases.release(lease)

    @contextmanager
    def _surviving(self) -> Iterator[None]:
        """Keep the first error of the address, after which it is not asked again."""
        try:
            yield
        except DamagedResult:
            raise
        except (SimReconError, OSError) as error:
            logger.info("%s", error)
            self._failure = self._failure or str(error)
