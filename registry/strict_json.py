# pyright: strict
"""Parse untrusted JSON so that every other reader sees the same: one meaning, bounded memory, plain strings."""

import json
from functools import partial
from math import isinf
from pathlib import Path
from typing import Any, cast

from registry.errors import BundleError
from registry.plain_text import is_plain, may_have_controls

MAX_CONTAINERS = 500_000  # objects and lists
MAX_VALUES = 4_000_000  # commas
_MAX_DIGITS = 40  # of a whole number
_MAX_DEPTH = 64


def parse_json(
    data: bytes, where: str, *, max_containers: int = MAX_CONTAINERS, max_values: int = MAX_VALUES
) -> Any:
    """Parse strict JSON.

    Args:
        data: UTF-8 without a byte order mark.
        where: Begins every message.
        max_containers: Most objects and lists (brackets within strings count, too).
        max_values: Most values (commas within strings count, too).

    Raises:
        BundleError: It is not JSON, or has NaN, infinity, a duplicate key, a control character in a string (newline
            and tab are allowed), deeper nesting or more values than allowed.
    """
    if data.count(b"[") + data.count(b"{") > max_containers or data.count(b",") > max_values:
        raise BundleError(f"{where}: more than {max_containers} lists and objects or {max_values} values")
    try:
        text = data.decode("utf-8")
        value = json.loads(
            text,
            parse_constant=partial(_constant, where),
            parse_float=partial(_number, where),
            parse_int=partial(_whole, where),
            object_pairs_hook=partial(_pairs, where),
        )
    except BundleError:
        raise
    except RecursionError as error:
        raise BundleError(f"{where}: nested too deeply") from error
    except ValueError as error:
        raise BundleError(f"{where}: not JSON ({error})") from error
    if may_have_controls(data):
        _check_strings(value, where)
    return value


def read_json(path: Path, where: str, max_bytes: int) -> Any:
    """Parse a file of strict JSON of at most `max_bytes`.

    Raises:
        BundleError: As `parse_json`, or the file is too large.
        OSError: The file cannot be read.
    """
    with path.open("rb") as file:
        data = file.read(max_bytes + 1)
    if len(data) > max_bytes:
        raise BundleError(f"{where}: more than {max_bytes >> 20} MiB")
    return parse_json(data, where)


def _constant(where: str, name: str) -> None:
    raise BundleError(f"{where}: {name} is not strict JSON")


def _number(where: str, text: str) -> float:
    value = float(text)
    if isinf(value):
        raise BundleError(f"{where}: {text[:40]} is not a finite number")
    return value


def _whole(where: str, text: str) -> int:
    if len(text) > _MAX_DIGITS:
        raise BundleError(f"{where}: a whole number of {len(text)} digits")
    return int(text)


def _pairs(where: str, items: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(items)
    if len(found) != len(items):
        keys = sorted(key[:40] for key, _ in items)[:8]
        raise BundleError(f"{where}: a key appears twice in one object ({keys})")
    return found


def _check_strings(value: Any, where: str, place: str = "", depth: int = 0) -> None:
    """Raise BundleError at a string or key with a control character; name its place."""
    if depth > _MAX_DEPTH:
        raise BundleError(f"{where}: nested too deeply")
    if isinstance(value, str):
        if not is_plain(value, lines=True):
            raise BundleError(
                f"{where}: {place or 'it'}: a control character in the text {ascii(value)[:80]}"
            )
    elif isinstance(value, dict):
        for key, item in cast("dict[str, Any]", value).items():
            if not is_plain(key):
                raise BundleError(
                    f"{where}: {place or 'it'}: a control character in the key {ascii(key)[:80]}"
                )
            _check_strings(item, where, f"{place}.{key}" if place else key, depth + 1)
    elif isinstance(value, list):
        for number, item in enumerate(cast("list[Any]", value)):
            _check_strings(item, where, f"{place}[{number}]", depth + 1)
