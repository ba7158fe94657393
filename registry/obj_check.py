# pyright: strict
"""Check an untrusted Wavefront .obj: vertices and faces with finite numbers and valid indices, nothing else."""

import re
from pathlib import Path

import numpy as np

from registry.errors import BundleError
from registry.regular_files import read_regular

MAX_OBJ_BYTES = 32 << 20
MAX_OBJ_VERTICES, MAX_OBJ_FACES = 200_000, 400_000
_NUMBER = rb"[+-]?(?:\d{1,24}(?:\.\d{0,24})?|\.\d{1,24})(?:[eE][+-]?\d{1,2})?"
_VERTEX = re.compile(rb"v(?:[ \t]+" + _NUMBER + rb"){3}[ \t]*")
_OTHER_VERTEX = re.compile(rb"v[nt](?:[ \t]+" + _NUMBER + rb"){1,3}[ \t]*")
_FACE = re.compile(rb"f(?:[ \t]+[1-9]\d{0,8}(?:/\d{0,9}){0,2}){3,16}[ \t]*")
_NAME = re.compile(rb"(?:(?:[ogs]|usemtl)(?:[ \t][\x20-\x5b\x5d-\x7e\t]*)?|#[\x20-\x5b\x5d-\x7e\t]*)")
# All lines of a file as the project writes it, in the order of its exporters.
_PLAIN = re.compile(
    rb"(?:#[\x20-\x5b\x5d-\x7e]*\n|o [\x20-\x5b\x5d-\x7e]*\n)*"
    rb"((?:v(?: -?\d{1,6}(?:\.\d{1,16})?(?:e-\d\d)?){3}\n)+)((?:f(?: [1-9]\d{0,5}){3}\n)*)"
)
_INDEX = re.compile(rb"[ \t](\d+)")
MAX_OBJ_COORDINATE = 1e6


def check_obj(path: Path, name: str) -> int:
    """Check an .obj file and return its number of vertices.

    Raises:
        BundleError: A statement is not allowed or malformed, a number is too large, or a face has an index without a
            vertex; names the line.
        OSError: The file cannot be read.
    """
    data = read_regular(path, name, MAX_OBJ_BYTES)
    ordinary = _PLAIN.fullmatch(data)
    if ordinary is None:
        return _check_lines(data, name)
    vertices, faces = ordinary.group(1), ordinary.group(2)
    count = vertices.count(b"\n")
    _check_counts(count, faces.count(b"\n"), name)
    # Up to 6 digits before the point and no positive exponent: every coordinate is below the limit.
    if faces and np.fromstring(faces.replace(b"f", b""), np.int64, sep=" ").max() > count:
        return _check_lines(data, name)
    return count


def _check_lines(data: bytes, name: str) -> int:
    """Check line by line; slower, and names the line."""
    count, faces, largest, largest_line = 0, 0, 0, 0
    for number, raw in enumerate(data.split(b"\n"), start=1):
        line = raw.removesuffix(b"\r")
        if not line.strip(b" \t"):
            continue
        if _VERTEX.fullmatch(line):
            count += 1
            if max(abs(float(x)) for x in line.split()[1:]) > MAX_OBJ_COORDINATE:
                _fail(name, number, f"a coordinate of more than {MAX_OBJ_COORDINATE:g}")
        elif _FACE.fullmatch(line):
            faces += 1
            index = max(int(x) for x in _INDEX.findall(line))
            if index > largest:
                largest, largest_line = index, number
        elif not (_OTHER_VERTEX.fullmatch(line) or _NAME.fullmatch(line)):
            word = (line.split(None, 1) or [b""])[0][:40].decode("utf-8", "replace")
            _fail(name, number, f"{word!a} is not allowed in a bundle's mesh, or is malformed")
        _check_counts(count, faces, name)
    if largest > count:
        _fail(name, largest_line, f"a face with vertex {largest} of {count}")
    return count


def _check_counts(vertices: int, faces: int, name: str) -> None:
    if vertices > MAX_OBJ_VERTICES or faces > MAX_OBJ_FACES:
        raise BundleError(f"{name}: more than {MAX_OBJ_VERTICES} vertices or {MAX_OBJ_FACES} faces")


def _fail(name: str, line: int, message: str) -> None:
    raise BundleError(f"{name}: line {line}: {message}")
