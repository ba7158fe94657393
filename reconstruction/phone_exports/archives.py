"""Read members of a zip file of unknown origin, within bounds of size; every kind of damage is an `InputError`."""

import contextlib
import lzma
import struct
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path

from registry.errors import EnvironmentMissing, InputError

_DAMAGED = (
    zipfile.BadZipFile, zlib.error, lzma.LZMAError, struct.error, EOFError, RuntimeError, NotImplementedError,
    KeyError, ValueError, OSError,
)  # fmt: skip
_AGAIN = "export or copy it again"
# Photographs do not compress: an archive that unpacks to many times its size is made to fill memory or disk.
_MOST_TIMES, _SPARE_BYTES = 8, 256 << 20


@contextlib.contextmanager
def opened(path: Path) -> Iterator[zipfile.ZipFile]:
    """Open a zip file; errors while the block reads from it, too, name it.

    Raises:
        InputError: it is damaged or encrypted.
        EnvironmentMissing: it may not be read.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            yield archive
    except PermissionError as error:
        raise EnvironmentMissing(
            f"{path}: {error.strerror}. Make it readable (chmod u+r) and run again."
        ) from error
    except InputError:
        raise
    except _DAMAGED as error:
        if isinstance(error, OSError) and error.filename not in (None, str(path)):
            raise  # of another file, which is written
        raise InputError(f"{path} is a damaged zip file ({error}): {_AGAIN}") from error


def member_bytes(archive: zipfile.ZipFile, path: Path, name: str, most_bytes: int) -> bytes:
    """Return a member of an archive.

    Raises:
        InputError: there is none of this name, it is encrypted, damaged, or larger than `most_bytes`.
    """
    try:
        info = archive.getinfo(name)
        if info.flag_bits & 1:
            raise InputError(f"{path} is encrypted: export it without a password")
        if info.file_size <= most_bytes:
            with archive.open(info) as stream:  # never read more, whatever the archive announces
                data = stream.read(most_bytes + 1)
            if len(data) <= most_bytes:
                return data
    except InputError:
        raise
    except _DAMAGED as error:
        raise InputError(f"{path}: {name} in it is damaged or missing ({error}): {_AGAIN}") from error
    raise InputError(
        f"{path}: {name} in it is larger than {most_bytes >> 20} MB, which no export of a phone is"
    )


def check_total(archive: zipfile.ZipFile, path: Path, names: list[str]) -> None:
    """Check how much space members need.

    Raises:
        InputError: it is many times the size of the archive.
    """
    total = sum(archive.getinfo(name).file_size for name in names)
    if total > _MOST_TIMES * path.stat().st_size + _SPARE_BYTES:
        raise InputError(
            f"{path}: its {len(names)} images unpack to {total / 1e9:.1f} GB, {total // max(path.stat().st_size, 1)} "
            "times its size; photographs do not"
        )
