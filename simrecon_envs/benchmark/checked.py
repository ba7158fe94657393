"""Make dataclasses from JSON of other people: unknown, missing and wrongly typed fields are refused by name.

Numbers are finite and not negative, unless the caller says otherwise; `true` is no number.
"""

import math
import types
import typing
from collections.abc import Iterable
from dataclasses import MISSING, fields
from typing import Any, TypeVar

T = TypeVar("T")
_NAMES = {int: "a whole number", float: "a number", str: "text", bool: "true or false", dict: "an object"}
_LARGEST = 2**53  # up to which JSON numbers are exact everywhere
_LONGEST_TEXT = 10_000


def read_record(cls: type[T], entry: Any, where: str, *, negative: Iterable[str] = ()) -> T:
    """Return an instance of a dataclass from a JSON object.

    Args:
        cls: The dataclass; its fields have the types int, float, str, bool, dict, or tuples of these or of dataclasses.
        entry: The JSON value.
        where: Its place in the file, for errors: "tasks[3]".
        negative: Names of the fields that may be below zero.

    Raises:
        ValueError: a field is missing, unknown, or has another type; the message names it.
    """
    if not isinstance(entry, dict):
        raise ValueError(f"{where}: expected an object, found {_short(entry)}")
    hints = typing.get_type_hints(cls)
    known = {item.name: item for item in fields(cls)}  # type: ignore[arg-type]
    unknown = sorted(set(entry) - set(known))
    if unknown:
        raise ValueError(f"{where}: unknown field {_short(unknown[0])}")
    for name, item in known.items():
        if name not in entry and item.default is MISSING and item.default_factory is MISSING:
            raise ValueError(f"{where}: the field {name!r} is missing")
    values = {
        name: _value(hints[name], value, f"{where}.{name}", name in set(negative))
        for name, value in entry.items()
    }
    return cls(**values)


def read_list(value: Any, where: str) -> list:
    """Return a JSON list.

    Raises:
        ValueError: it is none.
    """
    if not isinstance(value, list):
        raise ValueError(f"{where}: expected a list, found {_short(value)}")
    return value


def read_text_map(value: Any, where: str) -> dict[str, str]:
    """Return a JSON object whose values are text.

    Raises:
        ValueError: it is none.
    """
    return {
        key: _value(str, text, f"{where}.{key}", False)
        for key, text in _value(dict, value, where, False).items()
    }


def _value(hint: Any, found: Any, where: str, negative: bool) -> Any:
    origin = typing.get_origin(hint)
    if origin in (typing.Union, types.UnionType):
        if found is None and type(None) in typing.get_args(hint):
            return None
        hint = next(one for one in typing.get_args(hint) if one is not type(None))
        origin = typing.get_origin(hint)
    if origin is tuple:
        inner = typing.get_args(hint)[0]
        return tuple(
            _value(inner, one, f"{where}[{number}]", negative)
            for number, one in enumerate(read_list(found, where))
        )
    value: Any = found
    kind = origin or hint
    if kind not in _NAMES:
        return read_record(kind, value, where)
    fits = isinstance(value, int | float) if kind is float else isinstance(value, kind)
    if not fits or (isinstance(value, bool) and kind is not bool):
        raise ValueError(f"{where}: expected {_NAMES[kind]}, found {_short(value)}")
    if kind in (int, float):
        if not (abs(value) <= _LARGEST and math.isfinite(value)) or (value < 0 and not negative):
            least = "" if negative else ", at least 0"
            raise ValueError(f"{where}: expected {_NAMES[kind]}{least}, found {_short(value)}")
        return kind(value)
    if isinstance(value, str) and (len(value) > _LONGEST_TEXT or not value.replace("\n", "").isprintable()):
        raise ValueError(f"{where}: expected printable text, found {_short(value)}")
    return value


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:80]} ..."
