"""A place: a folder at any fsspec address (local, s3://, gs://, hf://, memory://, http://) that holds shared scenes.

Writing needs neither a lock nor a rename: an object store shows an object when its upload is complete, and local files
are renamed into place. Keys are always relative, checked paths below the place.
"""

import asyncio
import contextlib
import re
from collections.abc import Generator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from registry.errors import BundleError, EnvironmentMissing, SimReconError, UsageError
from registry.exchange.wholefile import whole_file

if TYPE_CHECKING:
    from upath import UPath

_CHUNK = 1 << 20
_AT_ONCE = 16
_TAKEN = ("PreconditionFailed", "ConditionalRequestConflict")
_BLOCK = 8 << 20  # bytes of a ranged request
_EXTRAS = {"s3": "s3", "s3a": "s3", "gs": "gs", "gcs": "gs", "hf": "hub"}
_DEPTH = 2  # folders below `index` and `packs`, their files included
_HTTP = ("http", "https")
_CONNECT_S, _READ_S = 15, 60
# Packages of fsspec's clients, the errors of which are no OSErrors.
_CLIENTS = (
    "botocore",
    "aiobotocore",
    "s3fs",
    "aiohttp",
    "gcsfs",
    "google",
    "huggingface_hub",
    "requests",
    "httpx",
)


@dataclass
class Place:
    """An opened address. `url` is shown in messages; it has no password and no query."""

    url: str
    fs: Any  # fsspec.AbstractFileSystem
    root: str
    catalog: dict[str, Any] | None = field(default=None, repr=False)  # of a read-only mirror, once read

    @property
    def read_only(self) -> bool:
        """Return whether the protocol cannot write."""
        return _protocol(self.fs) in _HTTP

    def read(self, key: str, limit: int) -> bytes:
        """Return the content of an object of at most `limit` bytes.

        Raises:
            FileNotFoundError: There is none.
            BundleError: It is larger.
            EnvironmentMissing: The place cannot be reached.
        """
        path = self._path(key)
        with place_errors(self.url, f"read {key}"):
            if self.read_only:
                with _open_to_read(self.fs, path) as stream:
                    data = _read_up_to(stream, limit + 1)
            else:  # in one request, as another writer may replace the object meanwhile
                size = min(self.fs.info(path)["size"], limit + 1)
                data = self.fs.cat_file(path, start=0, end=size) if size else b""
        if len(data) > limit:
            raise BundleError(f"{self.url}: {key} has more than {limit} bytes")
        return data

    def read_many(self, keys: list[str], limit: int) -> list[bytes | None]:
        """Return the contents of objects, read 16 at once; None where there is none, or it is larger than `limit`.

        Raises:
            EnvironmentMissing: The place cannot be reached.
        """

        def read(key: str) -> bytes | None:
            try:
                return self.read(key, limit)
            except (FileNotFoundError, BundleError):
                return None

        with ThreadPoolExecutor(_AT_ONCE) as pool:
            return list(pool.map(read, keys))

    def fetch(self, key: str, target: Path, limit: int) -> None:
        """Download an object of at most `limit` bytes to a new file; errors as of `read`."""
        with place_errors(self.url, f"download {key}"):
            _download(self.fs, self._path(key), target, limit, f"{self.url}/{key}")

    def write(self, key: str, data: bytes) -> None:
        """Write an object at once.

        Raises:
            UsageError: The place is read-only, or its bucket does not exist.
            EnvironmentMissing: It cannot be written.
        """
        with self._writing(f"write {key}"):
            if _is_local(self.fs):
                with whole_file(Path(self._path(key)), sweep="*") as stream:
                    stream.write(data)
            else:
                self.fs.pipe_file(self._path(key), data)

    def create(self, key: str, data: bytes) -> bool:
        """Write an object unless there is one; return whether it was written.

        In a folder and on S3 only one of several writers gets True; other clients of fsspec look first.

        Raises:
            As `write`.
        """
        with self._writing(f"create {key}"):
            path = self._path(key)
            try:
                if _is_local(self.fs):
                    Path(path).parent.mkdir(parents=True, exist_ok=True)
                    with Path(path).open("xb") as stream:
                        stream.write(data)
                else:
                    self.fs.pipe_file(path, data, mode="create")
            except FileExistsError:
                return False
            except OSError as error:  # how s3fs says that a condition failed
                if getattr(error.__cause__, "response", {}).get("Error", {}).get("Code") not in _TAKEN:
                    raise
                return False
        return True

    def remove(self, keys: list[str]) -> None:
        """Delete objects; absent ones are no error.

        Raises:
            UsageError: The place is read-only.
            EnvironmentMissing: It cannot be reached or written.
        """
        for key in keys:
            with self._writing(f"delete {key}"), contextlib.suppress(FileNotFoundError):
                self.fs.rm_file(self._path(key))

    def modified_s(self, key: str) -> float:
        """Return when an object was written, as a POSIX timestamp; 0 if the client does not say."""
        with place_errors(self.url, f"look up {key}"):
            try:
                return self.fs.modified(self._path(key)).timestamp()
            except (NotImplementedError, AttributeError):
                return 0.0

    def upload(self, key: str, source: Path) -> None:
        """Upload a local file as one object; errors as of `write`."""
        with self._writing(f"upload {key}"):
            if not _is_local(self.fs):
                self.fs.put_file(str(source), self._path(key))
                return
            with whole_file(Path(self._path(key)), sweep="*") as stream, source.open("rb") as file:
                while chunk := file.read(_CHUNK):
                    stream.write(chunk)

    def exists(self, key: str) -> bool:
        """Return whether there is such an object."""
        with place_errors(self.url, f"look up {key}"):
            self.fs.invalidate_cache()
            return bool(self.fs.exists(self._path(key)))

    def keys(self, folder: str, prefix: str = "") -> list[str]:
        """Return the keys of all objects below a folder, relative to it; an absent folder has none.

        Args:
            folder: Key of the folder.
            prefix: Hint that only names with this beginning are needed; object stores list no others.
        """
        path = self._path(folder)
        options: dict[str, Any] = {}
        if self.read_only:
            options = {"maxdepth": _DEPTH}  # a server could list folders without end
        elif prefix and _protocol(self.fs) in ("s3", "s3a", "gs", "gcs"):
            options = {"prefix": prefix}
        with place_errors(self.url, f"list {folder}"):
            self.fs.invalidate_cache()
            try:
                found = self.fs.find(path, **options)
            except FileNotFoundError:
                return []
        start = path.rstrip("/") + "/"
        return [name[len(start) :] for name in map(str, found) if name.startswith(start)]

    def _path(self, key: str) -> str:
        return f"{self.root.rstrip('/')}/{key}"

    @contextlib.contextmanager
    def _writing(self, doing: str) -> Generator[None, None, None]:
        if self.read_only:
            raise UsageError(
                f"{self.url} is read-only: scenes are pulled over HTTP, and pushed to a folder, s3://, gs:// or hf://"
            )
        try:
            with place_errors(self.url, doing):
                yield
        except FileNotFoundError as error:
            raise UsageError(
                f"{self.url}: cannot {doing}: {_line(error)}. Make the bucket or repository first, or check its name"
            ) from error


def open_place(address: str | Path) -> Place:
    """Return the place at a folder or an fsspec address; reaches no network.

    Raises:
        UsageError: There is no such protocol.
        EnvironmentMissing: The extra of the protocol is not installed; names it.
    """
    text = str(Path(address).expanduser().absolute()) if "://" not in str(address) else str(address)
    fs, root = _file_system(text)
    return Place(url=shown(text).rstrip("/"), fs=fs, root=root)


def open_path(address: str) -> "UPath":
    """Return a path object of an fsspec address (`universal_pathlib`); reaches no network.

    Raises:
        UsageError: There is no such protocol.
        EnvironmentMissing: The extra of the protocol is not installed; names it.
    """
    from upath import UPath

    _file_system(address)  # for its errors
    return UPath(address, **_options(address.split("://")[0].lower()))


def download(url: str, target: Path, limit: int) -> None:
    """Download a URL of at most `limit` bytes to a new file.

    Raises:
        UsageError: The protocol or the object does not exist.
        BundleError: The object is larger.
        EnvironmentMissing: It cannot be reached, or the extra of the protocol is not installed.
    """
    fs, path = _file_system(url)
    try:
        with place_errors(shown(url), "download it"):
            _download(fs, path, target, limit, shown(url))
    except FileNotFoundError:
        raise UsageError(f"{shown(url)}: there is no such object") from None


def local_path(url: str) -> Path | None:
    """Return the path of a `file://` or `local://` URL; None for other protocols."""
    if url.split("://")[0].lower() not in ("file", "local"):
        return None
    fs, path = _file_system(url)
    return Path(path) if _is_local(fs) else None


def shown(url: str) -> str:
    """Return a URL without user, password and query, for messages."""
    return re.sub(r"//[^/@\s]*@", "//", url.split("?")[0]) if "://" in url else url


@contextlib.contextmanager
def place_errors(url: str, doing: str) -> Generator[None, None, None]:
    """Turn the errors of fsspec's clients into EnvironmentMissing; FileNotFoundError passes."""
    try:
        yield
    except SimReconError:
        raise
    except FileNotFoundError as error:
        if (cause := _unreachable(error)) is None:
            raise
        raise _failed(url, doing, cause) from error
    except PermissionError as error:
        raise EnvironmentMissing(
            f"{url}: cannot {doing}: permission denied. Check the credentials (docs/sharing.md#credentials)"
        ) from error
    except ImportError as error:
        raise EnvironmentMissing(f"{url}: cannot {doing}: {_line(error)}") from error
    except Exception as error:
        if (
            not isinstance(error, OSError | asyncio.TimeoutError)
            and type(error).__module__.split(".")[0] not in _CLIENTS
        ):
            raise
        raise _failed(url, doing, error) from error


def _failed(url: str, doing: str, error: BaseException) -> EnvironmentMissing:
    return EnvironmentMissing(
        f"{url}: cannot {doing}: {_line(error)}. Check the address, the network and the credentials "
        "(docs/sharing.md#credentials); run it again, nothing is left half done"
    )


def _unreachable(error: FileNotFoundError) -> BaseException | None:
    """Return why a server could not be asked: fsspec reports every failure over HTTP as a missing file."""
    cause = error.__cause__
    if cause is None or not (
        isinstance(cause, TimeoutError | asyncio.TimeoutError) or type(cause).__module__.startswith("aiohttp")
    ):
        return None
    return None if getattr(cause, "status", None) in (404, 410) else cause


def _file_system(url: str) -> tuple[Any, str]:
    protocol = url.split("::")[0].split("://")[0].lower() if "://" in url else "file"
    try:
        import fsspec

        return fsspec.core.url_to_fs(url, **_options(protocol))
    except ImportError as error:
        extra = _EXTRAS.get(protocol)
        advice = f"pip install 'simrecon[{extra}]'" if extra else _line(error)
        raise EnvironmentMissing(f"{shown(url)}: {protocol}:// needs more packages: {advice}") from error
    except ValueError as error:
        raise UsageError(
            f"{shown(url)}: {_line(error)}. Places are folders, s3://, gs://, hf://, https:// or others of fsspec"
        ) from error


def _options(protocol: str) -> dict[str, Any]:
    """Return arguments of a file system: no cached listings, bounded waits."""
    options: dict[str, Any] = {"use_listings_cache": False}
    if protocol in _HTTP:
        import aiohttp

        wait = aiohttp.ClientTimeout(total=None, sock_connect=_CONNECT_S, sock_read=_READ_S)
        options["client_kwargs"] = {"timeout": wait}
    elif protocol in ("s3", "s3a"):
        # s3fs itself tries again, too.
        retries = {"max_attempts": 2, "mode": "standard"}
        options["config_kwargs"] = {
            "connect_timeout": _CONNECT_S,
            "read_timeout": _READ_S,
            "retries": retries,
        }
    return options


def _protocol(fs: Any) -> str:
    return fs.protocol if isinstance(fs.protocol, str) else fs.protocol[0]


def _is_local(fs: Any) -> bool:
    return _protocol(fs) in ("file", "local")


def _open_to_read(fs: Any, path: str) -> Any:
    if _protocol(fs) in _HTTP:
        return fs.open(path, "rb", block_size=0)  # one stream: servers need not know ranges
    return fs.open(path, "rb", block_size=_BLOCK, cache_type="readahead")


def _read_up_to(stream: Any, limit: int) -> bytes:
    parts: list[bytes] = []
    while limit > 0 and (chunk := stream.read(min(limit, _CHUNK))):
        parts.append(chunk)
        limit -= len(chunk)
    return b"".join(parts)


def _download(fs: Any, path: str, target: Path, limit: int, name: str) -> None:
    done = 0
    with _open_to_read(fs, path) as stream, target.open("xb") as file:
        while chunk := stream.read(_CHUNK):
            done += len(chunk)
            if done > limit:
                raise BundleError(f"{name}: has more than {limit} bytes")
            file.write(chunk)


def _line(error: BaseException) -> str:
    text = shown(" ".join(str(error).split()))[:300]
    return f"{type(error).__name__}: {text}" if text else type(error).__name__
