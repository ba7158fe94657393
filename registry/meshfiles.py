# pyright: strict
"""Check that mesh files reference no other files: `uri` in glTF, `mtllib` in Wavefront.

Mesh loaders (SAPIEN, trimesh, viewers) follow such references, so an untrusted bundle could read outside its folder.
"""

import json
import struct
from pathlib import Path
from typing import Any, cast

from registry.errors import BundleError
from registry.schema import as_object

_GLB_MAGIC = 0x46546C67
_GLB_JSON = 0x4E4F534A
_MAX_GLB_JSON_BYTES = 32 << 20
_OBJ_STATEMENTS = frozenset((b"v", b"vn", b"vt", b"f", b"o", b"g", b"s", b"l", b"p", b"#", b"usemtl"))


def check_mesh_file(path: Path, name: str) -> None:
    """Check the header of a .glb or the statements of an .obj; other files are accepted unread.

    Raises:
        BundleError: The mesh references another file, or does not have the format of its suffix.
    """
    if name.endswith(".glb"):
        _check_glb(path, name)
    elif name.endswith(".obj"):
        _check_obj(path, name)


def _check_glb(path: Path, name: str) -> None:
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(20)
        if len(head) < 20:
            raise BundleError(f"{name}: not a binary glTF file (only {len(head)} bytes)")
        magic, version, total, length, kind = struct.unpack("<5I", head)
        if magic != _GLB_MAGIC or version != 2 or kind != _GLB_JSON or total != size:
            raise BundleError(f"{name}: not a binary glTF 2.0 file of {size} bytes")
        if length > min(_MAX_GLB_JSON_BYTES, size - 20):
            raise BundleError(f"{name}: its glTF header claims {length} bytes of JSON")
        text = file.read(length)
    try:
        document = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise BundleError(f"{name}: its glTF header is not JSON ({error})") from error
    if not isinstance(document, dict):
        raise BundleError(f"{name}: its glTF header is not a JSON object")
    for group in ("buffers", "images"):
        items = as_object(document).get(group)
        for i, item in enumerate(cast("list[Any]", items) if isinstance(items, list) else []):
            uri = as_object(item).get("uri")
            if uri is not None and not (isinstance(uri, str) and uri.startswith("data:")):
                raise BundleError(f"{name}: {group}[{i}].uri names another file ({str(uri)[:80]!r})")


def _check_obj(path: Path, name: str) -> None:
    with path.open("rb") as file:
        for number, line in enumerate(file, start=1):
            words = line.split(None, 1)
            if words and words[0] not in _OBJ_STATEMENTS and not words[0].startswith(b"#"):
                shown = words[0][:40].decode("utf-8", "replace")
                raise BundleError(f"{name}: line {number}: {shown!r} is not allowed in a bundle's mesh")
