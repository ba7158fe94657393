"""Read and check the vertices of `.ply` files."""

import re
from pathlib import Path

import numpy as np

from registry.errors import BundleError
from registry.regular_files import open_regular

MAX_PLY_VERTICES = 20_000_000
_MAX_HEADER_BYTES, _MAX_PROPERTIES = 64 << 10, 128
_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
_PROPERTY = re.compile(r"property ([a-z0-9]{1,8}) ([A-Za-z0-9_]{1,64})")
_END = b"\nend_header\n"


def read_vertices(path: Path) -> dict[str, np.ndarray]:
    """Return the properties of a PLY's vertices, binary or ASCII, by name, each (n,).

    Raises:
        BundleError: it is not a PLY of vertices, or it is truncated.
    """
    from plyfile import PlyData, PlyParseError

    try:
        columns = PlyData.read(path)["vertex"].data
    except (PlyParseError, KeyError, ValueError) as error:
        raise BundleError(f"{path}: not a PLY of vertices, or damaged ({error})") from error
    return {name: columns[name] for name in columns.dtype.names or ()}


def check_ply(path: Path, name: str) -> int:
    """Check the header of a bundle's PLY and its size; return the number of vertices. The numbers are not read.

    Accepted is one element `vertex` of scalar properties, binary little endian: the number of bytes follows from the
    header.

    Raises:
        BundleError: It is something else, or it is truncated.
        OSError: It cannot be read.
    """
    file, size = open_regular(path, name)
    with file:
        head = file.read(_MAX_HEADER_BYTES)
    end = head.find(_END)
    if end < 0 or (not head.isascii() and not head[:end].isascii()):
        raise BundleError(
            f"{name}: not a PLY file, or its header is longer than {_MAX_HEADER_BYTES >> 10} KiB"
        )
    lines = [x for x in head[:end].decode("ascii").split("\n") if not x.startswith(("comment ", "obj_info "))]
    match = re.fullmatch(r"element vertex (\d{1,9})", lines[2]) if len(lines) > 2 else None
    if lines[:2] != ["ply", "format binary_little_endian 1.0"] or match is None:
        raise BundleError(f"{name}: expected a binary little-endian PLY with the one element vertex")
    properties = [_PROPERTY.fullmatch(line) for line in lines[3:]]
    known = [found for found in properties if found is not None and found.group(1) in _TYPES]
    if not 1 <= len(known) == len(properties) <= _MAX_PROPERTIES:
        raise BundleError(
            f"{name}: expected 1 to {_MAX_PROPERTIES} scalar properties of the vertices, nothing else"
        )
    if len({found.group(2) for found in known}) != len(known):
        raise BundleError(f"{name}: a property is there twice")
    count, row = int(match.group(1)), sum(np.dtype(_TYPES[found.group(1)]).itemsize for found in known)
    if count > MAX_PLY_VERTICES or end + len(_END) + count * row != size:
        raise BundleError(
            f"{name}: {size} bytes do not hold the {count} vertices of {row} bytes that it claims"
        )
    return count
