# pyright: strict, reportUnknownMemberType=false, reportUnknownArgumentType=false, reportUnknownVariableType=false
"""Check one value of a parsed JSON file. `where` is the JSON place of the object that contains it."""

import math
from itertools import chain
from typing import Any, NoReturn, TypeAlias, cast

import numpy as np

from registry.errors import BundleError
from registry.plain_text import is_plain

JsonObject: TypeAlias = dict[str, Any]

MAX_METRES = 1e4  # bounds coordinates and extents
_RIGID_TOLERANCE = 1e-4  # of an entry of R R^T - I
_MAX_PATH_CHARACTERS = 240
_MAX_TEXT_CHARACTERS = 4096


def check_relative_path(path: Any, where: str) -> str:
    """Return a safe path inside the bundle unchanged; raise BundleError if it could leave the folder on any system."""
    if not isinstance(path, str) or not path or len(path) > _MAX_PATH_CHARACTERS:
        fail(where, f"a relative path of 1 to {_MAX_PATH_CHARACTERS} characters", path)
    unsafe = "\\" in path or ":" in path or not is_plain(path)
    if unsafe or path.startswith(("/", "~")) or any(part in ("", ".", "..") for part in path.split("/")):
        raise BundleError(f"{where}: {show(path)} is not a plain relative path inside the bundle")
    return path


def fail(place: str, expected: str, got: Any) -> NoReturn:
    """Raise BundleError: the place, the expected and the found value."""
    raise BundleError(f"{place}: expected {expected}, got {show(got)}")


def show(value: Any) -> str:
    """Return a short text of a value for a message; control characters are escaped."""
    if value is None:
        return "nothing"
    if isinstance(value, str | list | dict | int) and not isinstance(value, bool):
        value, cut = _cut(value)
        text = (
            value
            if isinstance(value, str) and value.startswith("a ") and is_plain(value)
            else ascii_text(value)
        )
        return text if len(text) <= 80 and not cut else text[:77] + "..."
    return ascii_text(value)[:80]


def _cut(value: Any) -> tuple[Any, bool]:
    """Return the beginning of a large value, and whether something was cut off."""
    if isinstance(value, str):
        return value[:200], len(value) > 200
    if isinstance(value, int) and abs(value) >= 10**40:
        return "a whole number of more than 40 digits", False
    if isinstance(value, list):
        return [_cut(x)[0] for x in cast("list[Any]", value)[:20]], len(cast("list[Any]", value)) > 20
    if isinstance(value, dict):
        items = list(cast("dict[str, Any]", value).items())
        return {key[:80]: _cut(x)[0] for key, x in items[:20]}, len(items) > 20
    return value, False


def ascii_text(value: Any) -> str:
    """Return `repr` of a value with control characters escaped."""
    text = repr(value)
    return text if is_plain(text) else ascii(value)


def get(mapping: JsonObject, key: str, where: str) -> Any:
    """Return the value of a key that must exist."""
    if key not in mapping:
        raise BundleError(f"{place_of(where, key)}: missing")
    return mapping[key]


def place_of(where: str, key: str) -> str:
    """Return the JSON place of a key."""
    return f"{where}.{key}" if where else key


def as_object(value: Any) -> JsonObject:
    """Return a parsed JSON value as an object; an empty one if it is of another type."""
    return cast(JsonObject, value) if isinstance(value, dict) else {}


def mapping(value: Any, place: str) -> JsonObject:
    """Check an object."""
    if not isinstance(value, dict):
        fail(place, "an object {...}", value)
    return cast(JsonObject, value)


def sequence(value: Any, place: str, most: int = 4_000_000) -> list[Any]:
    """Check a list of at most `most` entries."""
    if not isinstance(value, list):
        fail(place, "a list [...]", value)
    if len(cast("list[Any]", value)) > most:
        fail(place, f"at most {most} entries", len(cast("list[Any]", value)))
    return cast("list[Any]", value)


def text(mapping: JsonObject, key: str, where: str, empty: bool = False) -> str:
    """Check a text of one line without control characters; `empty` allows ""."""
    value = get(mapping, key, where)
    check_line(value, place_of(where, key))
    if not value and not empty:
        fail(place_of(where, key), "a text that is not empty", value)
    return value


def check_line(value: Any, place: str) -> None:
    """Check that a value is a text of one line without control characters."""
    if not isinstance(value, str) or len(value) > _MAX_TEXT_CHARACTERS:
        fail(place, f"a text that is not empty, of at most {_MAX_TEXT_CHARACTERS} characters", value)
    if not is_plain(value):
        fail(place, "a text of one line without control characters", value)


def boolean(mapping: JsonObject, key: str, where: str) -> bool:
    """Check true or false."""
    value = get(mapping, key, where)
    if not isinstance(value, bool):
        fail(place_of(where, key), "true or false", value)
    return value


def integer(mapping: JsonObject, key: str, where: str, low: int = -(2**31), high: int = 2**31 - 1) -> int:
    """Check a whole number within limits."""
    value = get(mapping, key, where)
    if not isinstance(value, int) or isinstance(value, bool) or not low <= value <= high:
        if high < 2**31 - 1 and not (isinstance(value, int) and value < low):
            fail(place_of(where, key), f"a whole number from {low} to {high}", value)
        fail(place_of(where, key), "a whole number" + (f" of at least {low}" if low >= 0 else ""), value)
    return value


def finite(value: Any) -> bool:
    """Return whether a value is a finite number."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return abs(value) <= 1e300 and math.isfinite(value)


def number(
    mapping: JsonObject,
    key: str,
    where: str,
    low: float = -1e300,
    high: float = 1e300,
    positive: bool = False,
) -> float:
    """Check a finite number within limits."""
    value = get(mapping, key, where)
    if not finite(value) or not low <= value <= high or (positive and value <= 0):
        kind = "a positive number" if positive else "a number"
        if high < 1e300 and not (high > 1e5 and not positive and finite(value) and value < low):
            kind += f" of at most {high:g}" if positive else f" between {low:g} and {high:g}"
        elif low > -1e300 and not positive:
            kind += f" of at least {low:g}"
        fail(place_of(where, key), kind, value)
    return value


def numbers(value: Any, count: int, high: float = 1e300) -> bool:
    """Return whether a value is a list of `count` finite numbers."""
    numbers = cast("list[Any]", value) if isinstance(value, list) else []
    return len(numbers) == count and all(finite(x) and abs(x) <= high for x in numbers)


def vector(mapping: JsonObject, key: str, where: str, count: int, high: float = 1e300) -> list[float]:
    """Check a list of `count` finite numbers."""
    value = get(mapping, key, where)
    if not numbers(value, count, high):
        fail(place_of(where, key), f"{count} finite numbers", value)
    return value


def matrix(value: Any, size: int, place: str) -> np.ndarray:
    """Check `size` rows of `size` finite numbers; return float64 (size, size)."""
    rows = cast("list[Any]", value) if isinstance(value, list) else []
    if len(rows) != size or not all(numbers(row, size) for row in rows):
        fail(place, f"{size} rows of {size} finite numbers", value)
    return np.array(value, dtype=np.float64)


def transform(mapping: JsonObject, key: str, where: str) -> None:
    """Check a rigid 4 x 4 transform."""
    place = place_of(where, key)
    found = matrix(get(mapping, key, where), 4, place)
    rotation = found[:3, :3]
    if np.abs(found[3] - [0, 0, 0, 1]).max() > 1e-9:
        fail(place, "the last row [0, 0, 0, 1]", mapping[key][3])
    if np.abs(rotation).max() > 2 or np.abs(rotation @ rotation.T - np.eye(3)).max() > _RIGID_TOLERANCE:
        fail(place, "a rigid transform (an orthonormal rotation, no scale)", mapping[key])
    if np.linalg.det(rotation) < 0:
        fail(place, "a rotation, not a reflection", mapping[key])
    if np.abs(found[:3, 3]).max() > MAX_METRES:
        fail(place, f"a translation within {MAX_METRES:g} m", found[:3, 3].tolist())


def are_transforms(items: list[Any]) -> bool:
    """Return whether every item is a rigid 4 x 4 transform, as `transform` checks one; all at once."""
    try:
        rows = list(chain.from_iterable(items))
        if not set(map(type, chain.from_iterable(rows))) <= {int, float}:
            return False
        found = np.array(items, np.float64)
    except (TypeError, ValueError, OverflowError):
        return False
    if found.shape != (len(items), 4, 4) or not np.isfinite(found).all():
        return False
    rotation = found[:, :3, :3]
    errors = np.abs(rotation @ rotation.transpose(0, 2, 1) - np.eye(3))
    return bool(
        np.abs(found[:, 3] - [0, 0, 0, 1]).max() <= 1e-9
        and np.abs(rotation).max() <= 2
        and errors.max() <= _RIGID_TOLERANCE
        and np.linalg.det(rotation).min() >= 0
        and np.abs(found[:, :3, 3]).max() <= MAX_METRES
    )


def unique(value: int, seen: set[int], place: str) -> None:
    """Check that a number is not in `seen`; add it."""
    if value in seen:
        raise BundleError(f"{place}: {value} is used twice")
    seen.add(value)


def path(mapping: JsonObject, key: str, where: str, suffix: str) -> str:
    """Check a relative path with a suffix."""
    path = check_relative_path(get(mapping, key, where), place_of(where, key))
    if not path.endswith(suffix):
        fail(place_of(where, key), f"a {suffix} file", path)
    return path


def paths(mapping: JsonObject, key: str, where: str, suffix: str) -> list[str]:
    """Check a list of relative paths with a suffix."""
    values = sequence(get(mapping, key, where), place_of(where, key))
    for k, path in enumerate(values):
        place = f"{place_of(where, key)}[{k}]"
        if not check_relative_path(path, place).endswith(suffix):
            fail(place, f"a {suffix} file", path)
    return values
