# pyright: strict
"""The container of binary glTF 2.0 files: a header, a JSON chunk and a binary chunk."""

import json
import struct
from pathlib import Path
from typing import Any

from registry.errors import BundleError
from registry.schema import as_object

_MAGIC, _JSON, _BIN = 0x46546C67, 0x4E4F534A, 0x004E4942
_MAX_JSON_BYTES = 32 << 20


def read_glb_json(path: Path, name: str) -> tuple[dict[str, Any], int]:
    """Read the JSON chunk of a .glb; return it, and the offset in bytes of the binary chunk's data.

    Raises:
        BundleError: `name` is no binary glTF 2.0 file, or is damaged.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(20)
        if len(head) < 20:
            raise BundleError(f"{name}: not a binary glTF file (only {len(head)} bytes)")
        magic, version, total, length, kind = struct.unpack("<5I", head)
        if magic != _MAGIC or version != 2 or kind != _JSON or total != size:
            raise BundleError(f"{name}: not a binary glTF 2.0 file of {size} bytes")
        if length > min(_MAX_JSON_BYTES, size - 20):
            raise BundleError(f"{name}: its glTF header claims {length} bytes of JSON")
        text = file.read(length)
    try:
        document = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise BundleError(f"{name}: its glTF header is not JSON ({error})") from error
    if not isinstance(document, dict):
        raise BundleError(f"{name}: its glTF header is not a JSON object")
    return as_object(document), 28 + length


def write_glb_chunks(path: Path, document: dict[str, Any], binary: bytes | bytearray) -> None:
    """Write a .glb of two chunks; the length of `binary` is a multiple of 4 bytes."""
    text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    with path.open("wb") as file:
        file.write(struct.pack("<3I", _MAGIC, 2, 12 + 8 + len(text) + 8 + len(binary)))
        file.write(struct.pack("<2I", len(text), _JSON) + text)
        file.write(struct.pack("<2I", len(binary), _BIN) + binary)
