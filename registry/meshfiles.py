# pyright: strict
"""Check that mesh files reference no other files: `uri` in glTF, `mtllib` in Wavefront.

Mesh loaders (SAPIEN, trimesh, viewers) follow such references, so an untrusted bundle could read outside its folder.
"""

from pathlib import Path
from typing import Any, cast

from registry.errors import BundleError
from registry.glb import read_glb_json
from registry.schema import as_object

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
    document, _ = read_glb_json(path, name)
    for group in ("buffers", "images"):
        items = document.get(group)
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
