"""The byte layout of a pack: a zip of stored entries without gaps; check an untrusted one before anything is written.

`simrecon pack` writes exactly one layout, and only that is accepted: no compression (so no bomb), no encryption, no
links, no folders, no comments, no extra fields, no byte between or beside the entries.
"""

import os
import stat
import struct
import unicodedata
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from registry.bundle import MAX_FILE_BYTES, MAX_FILES, MAX_TOTAL_BYTES
from registry.errors import BundleError
from registry.schema import check_relative_path

SUFFIX = ".simrecon"
CARD = "README.md"
MAX_PACK_BYTES = (4 << 30) - 1  # what a zip without 64-bit extensions can hold
_MAX_LISTS = 1_000_000  # lists and objects in a JSON file: a parsed one takes 60 bytes and more
_MAX_BYTES = {CARD: 1 << 20, "manifest.json": 8 << 20, "scene.json": 16 << 20}
_END, _CENTRAL, _LOCAL = b"PK\x05\x06", b"PK\x01\x02", b"PK\x03\x04"
_END_FORMAT, _CENTRAL_FORMAT, _LOCAL_FORMAT = "<4s4H2IH", "<4s6H3I5H2I", "<4s5H3I2H"
_END_SIZE, _CENTRAL_SIZE, _LOCAL_SIZE = 22, 46, 30
_MAX_NAME_BYTES = 4 * 240
_DATE = 33  # 1 January 1980
_ZIP_VERSION, _UNIX = 20, 3
_UTF8, _ENCRYPTED = 0x800, 0x1
_CHUNK = 1 << 20


@dataclass(frozen=True)
class Member:
    """A file of a pack."""

    name: str
    offset: int  # of its content in the pack
    size: int  # bytes
    crc: int  # CRC-32


def open_pack(path: Path) -> BinaryIO:
    """Open a regular file for reading without waiting for a writer.

    Raises:
        BundleError: It is no regular file, or cannot be read.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | getattr(os, "O_NONBLOCK", 0))
    except OSError as error:
        raise BundleError(f"pack {path}: cannot be read ({error.strerror})") from error
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise BundleError(f"pack {path}: this is no regular file")
    return os.fdopen(descriptor, "rb")


def read_members(stream: BinaryIO, name: str) -> list[Member]:
    """Check the layout of a pack; return its files in order.

    Args:
        stream: The opened pack.
        name: Its name in errors.

    Raises:
        BundleError: The file is no pack, is damaged or unsafe, or exceeds a limit; names the first reason.
    """
    try:
        return _read_members(stream)
    except BundleError as error:
        raise BundleError(f"pack {name}: {error}") from error


def extract_members(stream: BinaryIO, members: list[Member], folder: Path, name: str) -> None:
    """Write the files of a checked pack, the card excepted, to an empty folder.

    Raises:
        BundleError: An entry does not match its CRC-32, or has too many JSON values.
        OSError: The folder cannot be written.
    """
    for member in members:
        if member.name == CARD:
            continue
        target = folder / member.name
        target.parent.mkdir(parents=True, exist_ok=True)
        stream.seek(member.offset)
        left, crc, lists = member.size, 0, 0
        with target.open("xb") as file:
            while left:
                chunk = stream.read(min(left, _CHUNK))
                if not chunk:
                    raise BundleError(f"pack {name}: {member.name} ends too early")
                left, crc = left - len(chunk), zlib.crc32(chunk, crc)
                lists += chunk.count(b"[") + chunk.count(b"{")
                file.write(chunk)
        if crc != member.crc:
            raise BundleError(f"pack {name}: {member.name} is damaged (CRC-32)")
        if member.name in _MAX_BYTES and lists > _MAX_LISTS:
            raise BundleError(
                f"pack {name}: {member.name} has {lists} lists and objects, more than {_MAX_LISTS}"
            )


def check_pack_sizes(sizes: dict[str, int]) -> None:
    """Check the files of a pack against its limits.

    Args:
        sizes: {path: bytes}.

    Raises:
        BundleError: Too many files, or too many bytes.
    """
    if len(sizes) > MAX_FILES:
        raise BundleError(f"{len(sizes)} files, more than {MAX_FILES}")
    for name, size in sizes.items():
        most = _MAX_BYTES.get(name, MAX_FILE_BYTES)
        if size > most:
            raise BundleError(f"{name} has {size} bytes, more than {most}")
    if sum(sizes.values()) > MAX_TOTAL_BYTES:
        raise BundleError(f"{sum(sizes.values())} bytes in all, more than {MAX_TOTAL_BYTES}")


def _read_members(stream: BinaryIO) -> list[Member]:
    size = stream.seek(0, os.SEEK_END)
    if size < _END_SIZE:
        raise BundleError(f"{size} bytes are no zip file")
    if size > MAX_PACK_BYTES:
        raise BundleError(f"{size} bytes, more than {MAX_PACK_BYTES}")
    count, start = _read_end(stream, size)
    stream.seek(start)
    directory = stream.read(size - _END_SIZE - start)
    members: list[Member] = []
    at = content = 0
    for _ in range(count):
        member, length = _read_entry(directory, at, content)
        at += length
        content = member.offset + member.size
        if content > start:
            raise BundleError(f"{member.name}: its content does not end before the list of files")
        _check_local_header(stream, member)
        members.append(member)
    if at != len(directory) or content != start:
        raise BundleError("there are bytes that belong to no file")
    _check_names([member.name for member in members])
    check_pack_sizes({member.name: member.size for member in members})
    return members


def _read_end(stream: BinaryIO, size: int) -> tuple[int, int]:
    """Return the number of files, and the offset of their list."""
    stream.seek(size - _END_SIZE)
    end = struct.unpack(_END_FORMAT, stream.read(_END_SIZE))
    signature, disk, first_disk, count_here, count, length, start, comment = end
    if signature != _END:
        raise BundleError("not a zip file as `simrecon pack` writes it, or cut off at its end")
    if disk or first_disk or comment or count_here != count:
        raise BundleError("it has parts or a comment; a pack has none")
    if not 0 < count <= MAX_FILES:
        raise BundleError(f"{count} files, expected 1 to {MAX_FILES}")
    if start + length + _END_SIZE != size or length > count * (_CENTRAL_SIZE + _MAX_NAME_BYTES):
        raise BundleError("the list of files is not where the end of the zip file says")
    return count, start


def _read_entry(directory: bytes, at: int, content: int) -> tuple[Member, int]:
    """Check an entry of the list of files; return it, and its length in bytes in the list.

    Args:
        directory: The list of files.
        at: Where the entry begins in it.
        content: Where the entry's local header must begin in the pack.
    """
    if at + _CENTRAL_SIZE > len(directory):
        raise BundleError("the list of files is cut off")
    fields = struct.unpack(_CENTRAL_FORMAT, directory[at : at + _CENTRAL_SIZE])
    (signature, made_by, version, flags, method, time, date, crc, packed, size) = fields[:10]
    (name_length, extra, comment, disk, _internal, attributes, offset) = fields[10:]
    raw = directory[at + _CENTRAL_SIZE : at + _CENTRAL_SIZE + name_length]
    if signature != _CENTRAL or len(raw) != name_length:
        raise BundleError("the list of files is damaged")
    try:
        name = raw.decode("utf-8" if flags & _UTF8 else "ascii")
    except UnicodeDecodeError as error:
        raise BundleError("a file's name is not UTF-8") from error
    check_relative_path(name, "name of a file")
    if not name.isprintable():  # C1 controls and bidirectional marks would reach terminals
        raise BundleError(f"name of a file: {name!r} is not a plain relative path: it cannot be shown")
    if flags & _ENCRYPTED:
        raise BundleError(f"{name}: encrypted")
    if method or packed != size:
        raise BundleError(f"{name}: compressed; the files of a pack are stored, make it with `simrecon pack`")
    if not stat.S_ISREG(attributes >> 16):
        raise BundleError(f"{name}: a link, folder or device; a pack has only regular files")
    expected_flags = 0 if name.isascii() else _UTF8
    plain = (flags, time, date, extra, comment, disk) == (expected_flags, 0, _DATE, 0, 0, 0)
    if not plain or (made_by, version) != (_UNIX << 8 | _ZIP_VERSION, _ZIP_VERSION):
        raise BundleError(f"{name}: not stored as `simrecon pack` does it")
    if offset != content:
        raise BundleError(f"{name}: its content overlaps that of another file, or leaves a gap")
    return Member(name, offset + _LOCAL_SIZE + name_length, size, crc), _CENTRAL_SIZE + name_length


def _check_local_header(stream: BinaryIO, member: Member) -> None:
    raw = member.name.encode()
    flags = 0 if member.name.isascii() else _UTF8
    numbers = (_ZIP_VERSION, flags, 0, 0, _DATE, member.crc, member.size, member.size, len(raw), 0)
    stream.seek(member.offset - _LOCAL_SIZE - len(raw))
    if stream.read(_LOCAL_SIZE + len(raw)) != struct.pack(_LOCAL_FORMAT, _LOCAL, *numbers) + raw:
        raise BundleError(f"{member.name}: named or described differently in two places of the zip file")


def _check_names(names: list[str]) -> None:
    """Refuse names that would be one file, or a file and a folder, on any usual file system."""
    seen: dict[str, str] = {}
    for name in names:
        key = unicodedata.normalize("NFC", name).casefold()
        if key in seen:
            raise BundleError(f"two files have the name {name!r}")
        seen[key] = name
    for key, name in seen.items():
        parts = key.split("/")
        for count in range(1, len(parts)):
            if "/".join(parts[:count]) in seen:
                raise BundleError(f"{name!r} lies in a folder that is a file, too")
    for required in ("scene.json", "manifest.json"):
        if required not in names:
            raise BundleError(f"{required} is missing")
