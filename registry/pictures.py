# pyright: strict
"""Size of a picture from its header, without decoding it: PNG and JPEG."""

import struct
import zlib

from registry.errors import BundleError

MAX_PIXELS = 8192 * 8192
MAX_SIDE = 16_384
_CHUNK_BYTES = 1 << 20
_PNG = b"\x89PNG\r\n\x1a\n"
_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # JPEG markers that begin a frame


def picture_size(data: bytes | memoryview, name: str, kind: str = "") -> tuple[int, int]:
    """Return the width and height of a PNG or JPEG in pixels.

    Args:
        data: The whole file.
        name: Begins every message.
        kind: "png" or "jpeg" if it must be that; "" for either.

    Raises:
        BundleError: It is neither, its header is damaged, or it has more than 8192 x 8192 pixels.
    """
    view = memoryview(data)
    if kind != "jpeg" and bytes(view[:8]) == _PNG:
        size = _png(view, name)
    elif kind != "png" and bytes(view[:2]) == b"\xff\xd8":
        size = _jpeg(view, name)
    else:
        raise BundleError(f"{name}: not a {kind.upper() or 'PNG or JPEG'} picture")
    width, height = size
    if not (0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE and width * height <= MAX_PIXELS):
        raise BundleError(f"{name}: {width} x {height} pixels, allowed are 1 to 8192 x 8192 in all")
    return size


def check_png_data(data: bytes | memoryview, name: str) -> None:
    """Decompress a PNG's pixels, at most as many bytes as its header claims.

    Raises:
        BundleError: It has more bytes (a decompression bomb) or fewer, or is damaged.
    """
    view = memoryview(data)
    width, height = picture_size(view, name, "png")
    depth, color = view[24], view[25]
    channels = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}.get(color, 0)
    # Interlaced pictures have up to seven passes, each with a filter byte a row and a rounded-up row.
    allowed = (
        (width * channels * depth + 7) // 8 * height + height + (16 * (width + height) if view[28] else 0)
    )
    inflater, found, at = zlib.decompressobj(), 0, 8
    try:
        while at + 12 <= len(view):
            length, kind = struct.unpack(">I4s", view[at : at + 8])
            if length > len(view) - at - 12:
                break
            if kind == b"IDAT":
                rest: bytes | memoryview = view[at + 8 : at + 8 + length]
                while len(rest):
                    found += len(inflater.decompress(rest, _CHUNK_BYTES))
                    rest = inflater.unconsumed_tail
                    if found > allowed:
                        raise BundleError(
                            f"{name}: its compressed data holds more than {width} x {height} pixels"
                        )
            if kind == b"IEND":
                break
            at += 12 + length
    except zlib.error as error:
        raise BundleError(f"{name}: its compressed data is damaged ({error})") from error
    if not inflater.eof:
        raise BundleError(f"{name}: its compressed data is cut off")


def _png(view: memoryview, name: str) -> tuple[int, int]:
    if len(view) < 33 or struct.unpack(">I4s", view[8:16]) != (13, b"IHDR"):
        raise BundleError(f"{name}: its PNG header is damaged")
    width, height = struct.unpack(">II", view[16:24])
    return width, height


def _jpeg(view: memoryview, name: str) -> tuple[int, int]:
    """Walk over the segments up to the first scan; exactly one of them begins a frame."""
    at, found = 2, None
    while at + 4 <= len(view):
        if view[at] != 0xFF:
            break
        marker = view[at + 1]
        if marker == 0xFF:  # a fill byte
            at += 1
            continue
        if marker == 0xDA:
            if found is None:
                break
            return found
        length = struct.unpack(">H", view[at + 2 : at + 4])[0]
        if marker in (0x01, 0xD8, 0xD9) or 0xD0 <= marker <= 0xD7 or length < 2:
            break
        if marker in _FRAMES:
            if found is not None or length < 8 or at + 9 > len(view):
                break
            height, width = struct.unpack(">HH", view[at + 5 : at + 9])
            found = width, height
        at += 2 + length
    raise BundleError(f"{name}: its JPEG header is damaged")
