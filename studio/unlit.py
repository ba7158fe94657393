"""Show baked textures as they are: mark the materials of a .glb as unlit."""

import json
import struct

_UNLIT = "KHR_materials_unlit"
_HEADER_BYTES, _CHUNK_HEADER_BYTES = 12, 8


def unlit(glb: bytes) -> bytes:
    """Return a binary glTF file whose materials have `KHR_materials_unlit`; its buffers are not touched.

    Textures of scenes are baked from photographs, so they contain the light of the room. Light added by a viewer would
    count twice, and shading costs a software renderer more than half of its time.
    """
    length = struct.unpack_from("<I", glb, _HEADER_BYTES)[0]
    start = _HEADER_BYTES + _CHUNK_HEADER_BYTES
    document = json.loads(glb[start : start + length])
    for material in document.get("materials", []):
        material.setdefault("extensions", {})[_UNLIT] = {}
    document["extensionsUsed"] = sorted({*document.get("extensionsUsed", []), _UNLIT})
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    rest = glb[start + length :]
    magic, version, _, _, kind = struct.unpack_from("<5I", glb)
    total = start + len(text) + len(rest)
    return struct.pack("<5I", magic, version, total, len(text), kind) + text + rest
