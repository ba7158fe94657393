# pyright: strict
"""The container of binary glTF 2.0 files: a header, a JSON chunk and a binary chunk."""

import json
import struct
from pathlib import Path
from typing import Any, cast

from registry.errors import BundleError
from registry.regular_files import read_regular
from registry.strict_json import parse_json

MAX_GLB_BYTES = 256 << 20
_MAGIC, _JSON, _BIN = 0x46546C67, 0x4E4F534A, 0x004E4942
_MAX_JSON_BYTES = 4 << 20
_MAX_CONTAINERS, _MAX_VALUES = 50_000, 500_000  # of the JSON chunk


def read_glb(path: Path, name: str) -> tuple[dict[str, Any], memoryview]:
    """Read a .glb; return its JSON chunk and its binary chunk, which is empty if there is none.

    Raises:
        BundleError: `name` is no binary glTF 2.0 file of one JSON chunk and at most one binary chunk, its JSON is not
            strict, or it is damaged.
    """
    data = memoryview(read_regular(path, name, MAX_GLB_BYTES))
    size = len(data)
    if size < 20:
        raise BundleError(f"{name}: not a binary glTF file (only {size} bytes)")
    magic, version, total, length, kind = struct.unpack("<5I", data[:20])
    if magic != _MAGIC or version != 2 or kind != _JSON or total != size:
        raise BundleError(f"{name}: not a binary glTF 2.0 file of {size} bytes")
    if length > min(_MAX_JSON_BYTES, size - 20) or length % 4:
        raise BundleError(f"{name}: its glTF header claims {length} bytes of JSON")
    document = parse_json(
        bytes(data[20 : 20 + length]),
        f"{name}: glTF header",
        max_containers=_MAX_CONTAINERS,
        max_values=_MAX_VALUES,
    )
    if not isinstance(document, dict):
        raise BundleError(f"{name}: its glTF header is not a JSON object")
    rest = data[20 + length :]
    if len(rest):
        if len(rest) < 8 or struct.unpack("<2I", rest[:8]) != (len(rest) - 8, _BIN):
            raise BundleError(
                f"{name}: expected one binary chunk of {max(len(rest) - 8, 0)} bytes after its JSON"
            )
        rest = rest[8:]
    return cast("dict[str, Any]", document), rest


def read_glb_json(path: Path, name: str) -> tuple[dict[str, Any], int]:
    """Read the JSON chunk of a .glb; return it, and the offset in bytes of the binary chunk's data.

    Raises:
        BundleError: As `read_glb`.
    """
    document, binary = read_glb(path, name)
    return document, path.stat().st_size - len(binary)


def write_glb_chunks(path: Path, document: dict[str, Any], binary: bytes | bytearray) -> None:
    """Write a .glb of two chunks; the length of `binary` is a multiple of 4 bytes."""
    text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    with path.open("wb") as file:
        file.write(struct.pack("<3I", _MAGIC, 2, 12 + 8 + len(text) + 8 + len(binary)))
        file.write(struct.pack("<2I", len(text), _JSON) + text)
        file.write(struct.pack("<2I", len(binary), _BIN) + binary)
