"""Show baked textures as they are: materials without light, textures through the inverse of the viewer's tone mapping.

Textures of scenes are baked from photographs, so they contain the light of the room: light of the viewer would count
twice, and shading costs a software renderer half of its time. viser renders with three.js' filmic tone mapping (ACES),
which has no switch; it would change values by up to 20 of 255, and the photographs beside the scene are not mapped.
"""

import json
import struct
from functools import lru_cache
from typing import Any

import numpy as np

from registry.errors import BundleError

_UNLIT = "KHR_materials_unlit"
_HEADER_BYTES, _CHUNK_HEADER_BYTES = 12, 8
# three.js r170, tonemapping_pars_fragment: matrices and curve of ACESFilmicToneMapping, at exposure 1.
_IN = np.array([[0.59719, 0.35458, 0.04823], [0.07600, 0.90834, 0.01566], [0.02840, 0.13383, 0.83777]])
_OUT = np.array([[1.60475, -0.53108, -0.07367], [-0.10208, 1.10813, -0.00605], [-0.00327, -0.07276, 1.07602]])
_CURVE = (0.0245786, 0.000090537, 0.983729, 0.4329510, 0.238081)
_EXPOSURE = 1 / 0.6
# White needs light beyond 1: textures are stored divided by this, and the factor of their material multiplies. At 8, no
# color is off by more than 4 of 255 (but saturated ones, which the curve does not reach), and on average by 1.
GAIN = 8.0
_STEP = 3  # of 255, between the colors for which the inverse is computed
_PNG_LEVEL = 2  # sent once over loopback: time matters more than size


def tone_map(linear: np.ndarray) -> np.ndarray:
    """Return the linear colors (..., 3) in 0 to 1 that three.js shows for linear colors (..., 3)."""
    a, b, c, d, e = _CURVE
    v = (np.asarray(linear, np.float64) * _EXPOSURE) @ _IN.T
    return np.clip(((v * (v + a) - b) / (v * (c * v + d) + e)) @ _OUT.T, 0, 1)


def inverse_tone_map(shown: np.ndarray) -> np.ndarray:
    """Return linear colors (..., 3), at least 0, that three.js shows as the linear colors `shown` (..., 3)."""
    a, b, c, d, e = _CURVE
    y = np.clip(np.asarray(shown, np.float64) @ np.linalg.inv(_OUT).T, 0, 1)
    # y = (v^2 + a v - b) / (c v^2 + d v + e), solved for the larger v.
    p, q, r = 1 - c * y, a - d * y, -(b + e * y)
    v = (-q + np.sqrt(np.maximum(q * q - 4 * p * r, 0))) / (2 * p)
    return np.maximum(v @ np.linalg.inv(_IN).T / _EXPOSURE, 0)


def to_linear(srgb: np.ndarray) -> np.ndarray:
    """Decode sRGB values in 0 to 1."""
    srgb = np.asarray(srgb, np.float64)
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def to_srgb(linear: np.ndarray) -> np.ndarray:
    """Encode linear values in 0 to 1."""
    linear = np.clip(np.asarray(linear, np.float64), 0, 1)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def compensate(image: np.ndarray) -> np.ndarray:
    """Return a texture, uint8 (h, w, 3) RGB, that is shown as `image` where its material's factor is `GAIN`."""
    red, green, blue = np.moveaxis(image // _STEP, -1, 0)
    return _table()[red, green, blue]


@lru_cache(maxsize=1)
def _table() -> np.ndarray:
    """Return uint8 (86, 86, 86, 3): the stored color of every third level of red, green and blue."""
    levels = to_linear((np.arange(0, 256, _STEP) + _STEP // 2) / 255)
    colors = np.stack(np.meshgrid(levels, levels, levels, indexing="ij"), axis=-1)
    return np.rint(255 * to_srgb(inverse_tone_map(colors) / GAIN)).astype(np.uint8)


def as_filmed(glb: bytes) -> bytes:
    """Return a binary glTF file that viser shows in the colors of its textures, whatever the light.

    Args:
        glb: a file of a bundle: base color factors and base color textures within the file.

    Raises:
        BundleError: a texture cannot be decoded.
    """
    length = struct.unpack_from("<I", glb, _HEADER_BYTES)[0]
    start = _HEADER_BYTES + _CHUNK_HEADER_BYTES
    document = json.loads(glb[start : start + length])
    binary = glb[start + length + _CHUNK_HEADER_BYTES :]
    for material in document.get("materials", []):
        _set_colors(material)
    document["extensionsUsed"] = sorted({*document.get("extensionsUsed", []), _UNLIT})
    images = {image["bufferView"]: image for image in document.get("images", []) if "bufferView" in image}
    out = bytearray()
    for number, view in enumerate(document.get("bufferViews", [])):
        first = view.get("byteOffset", 0)
        data = binary[first : first + view["byteLength"]]
        if number in images:
            data = _recoded(data)
            images[number]["mimeType"] = "image/png"
        view["byteOffset"], view["byteLength"] = len(out), len(data)
        out += data + b"\0" * (-len(data) % 4)
    document["buffers"] = [{"byteLength": len(out)}]
    return _packed(document, bytes(out))


def _set_colors(material: dict[str, Any]) -> None:
    material.setdefault("extensions", {})[_UNLIT] = {}
    base = material.setdefault("pbrMetallicRoughness", {})
    factor = base.get("baseColorFactor", [1.0, 1.0, 1.0, 1.0])
    if "baseColorTexture" in base:
        base["baseColorFactor"] = [*(GAIN * x for x in factor[:3]), factor[3]]
    else:
        base["baseColorFactor"] = [*inverse_tone_map(np.array(factor[:3])).tolist(), factor[3]]


def _recoded(data: bytes) -> bytes:
    import cv2

    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    if image is None:
        raise BundleError("a texture cannot be decoded")
    done, out = cv2.imencode(
        ".png", compensate(image[..., ::-1])[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, _PNG_LEVEL]
    )
    if not done:
        raise BundleError("a texture cannot be encoded")
    return out.tobytes()


def _packed(document: dict[str, Any], binary: bytes) -> bytes:
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<3I", 0x46546C67, 2, 12 + 8 + len(text) + 8 + len(binary))
    return (
        head
        + struct.pack("<2I", len(text), 0x4E4F534A)
        + text
        + struct.pack("<2I", len(binary), 0x004E4942)
        + binary
    )
