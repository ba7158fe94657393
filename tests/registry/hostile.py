"""Makes hostile bundles: each function changes a sealed bundle, whose manifest is then made to agree."""

import hashlib
import json
import os
import shutil
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np

from registry import content_revision


def reseal(folder: Path, scene_text: str | None = None) -> None:
    """Write a manifest that agrees with the files, as an attacker would; nothing is checked."""
    if scene_text is not None:
        (folder / "scene.json").write_bytes(scene_text.encode("utf-8", "surrogatepass"))
    files = {}
    for path in sorted(folder.rglob("*")):
        name = str(path.relative_to(folder))
        if path.is_file() and not path.is_symlink() and name != "manifest.json":
            data = path.read_bytes()
            files[name] = (hashlib.sha256(data).hexdigest(), len(data))
    try:
        revision = content_revision(json.loads((folder / "scene.json").read_bytes()), files)
    except (ValueError, RecursionError, KeyError, TypeError, AttributeError):
        revision = "0" * 16
    listed = {name: {"sha256": digest, "bytes": size} for name, (digest, size) in files.items()}
    document = {"format": "simrecon.manifest/1", "revision": revision, "files": listed}
    (folder / "manifest.json").write_text(json.dumps(document))


def png(width: int, height: int, data: bytes | None = None) -> bytes:
    """Return a gray PNG with a header of any size and any compressed data."""
    data = zlib.compress(bytes((width + 1) * height)) if data is None else data

    def chunk(kind: bytes, content: bytes) -> bytes:
        return (
            struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))
        )

    head = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", data) + chunk(b"IEND", b"")


def bomb_png() -> bytes:
    """Return a PNG of one pixel whose data decompresses to 640 MiB."""
    packer, out = zlib.compressobj(1), []
    for _ in range(640):
        out.append(packer.compress(bytes(1 << 20)))
    return png(1, 1, b"".join(out) + packer.flush())


def textured(document: dict, picture: bytes, triangle: bytes) -> tuple[dict, bytes]:
    """Add a texture to the document of one triangle; return it and the binary chunk."""
    document["images"] = [{"bufferView": 2, "mimeType": "image/png"}]
    document["textures"] = [{"source": 0}]
    document["materials"] = [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}]
    document["meshes"][0]["primitives"][0]["material"] = 0
    document["bufferViews"].append({"buffer": 0, "byteOffset": len(triangle), "byteLength": len(picture)})
    binary = triangle + picture + b"\0" * (-len(picture) % 4)
    document["buffers"][0]["byteLength"] = len(binary)
    return document, binary


def node_graph(depth: int) -> list[dict]:
    """Return nodes each of which uses the next one twice: 2 ** depth meshes are drawn."""
    return [*({"children": [i + 1, i + 1]} for i in range(depth)), {"mesh": 0}]


def chained(scene: dict, count: int) -> None:
    """Make `count` objects, each attached to the one before."""
    model = scene["objects"][0]
    scene["objects"] = [{**model, "id": 10 + k} for k in range(count)]
    scene["graph"]["edges"] = [
        {
            "child": 10 + k,
            "relation": "attached_to",
            "parent": 9 + k if k else 1,
            "confidence": 1,
            "evidence": "",
        }
        for k in range(count)
    ]


def many_objects(scene: dict, count: int) -> None:
    """Make `count` objects on the floor."""
    chained(scene, count)
    for edge in scene["graph"]["edges"]:
        edge["parent"] = 1


def put(scene: dict, place: str, value: object) -> None:
    """Set the value at a place such as `objects[0].label`."""
    *path, last = place.replace("[", ".").replace("]", "").split(".")
    target: object = scene
    for key in path:
        target = target[int(key)] if isinstance(target, list) else target.setdefault(key, {})  # type: ignore[index]
    target[int(last) if isinstance(target, list) else last] = value  # type: ignore[index]


def replace_by(kind: str, outside: Path) -> Callable[[Path], None]:
    """Return a function that replaces a mesh by a link, a pipe or a folder."""

    def change(folder: Path) -> None:
        path = folder / "objects/002/visual.glb"
        path.unlink()
        if kind == "link":
            path.symlink_to(outside)
        elif kind == "pipe":
            os.mkfifo(path)
        elif kind == "socket":
            os.mknod(path, 0o140644)
        else:
            path.mkdir()

    return change


def linked_folder(folder: Path, outside: Path) -> None:
    """Move a folder of the bundle away and link to it."""
    shutil.move(folder / "objects/002", outside)
    (folder / "objects/002").symlink_to(outside)


def floats(*values: float) -> bytes:
    """Return little-endian 32-bit floats."""
    return np.array(values, "<f4").tobytes()
