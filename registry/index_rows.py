# pyright: strict
"""Check the rows and the tables of an index that someone else may have written."""

import json
import math
import re
import sqlite3
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

from registry.errors import BundleError
from registry.plain_text import is_plain
from registry.schema import is_scene_id

_REVISION = re.compile(r"[0-9a-f]{16}")
_SHA256 = re.compile(r"[0-9a-f]{1,64}")
_SCENE_IDS = re.compile(r"(?:[a-z0-9_]{1,64}\n)*")
_REVISIONS = re.compile(r"(?:[0-9a-f]{16}\n)*")
_STATUS = ("stable", "unstable", "unchecked")
_MAX_TEXT, _MAX_METRICS, _MAX_OBJECTS = 4096, 100_000, 1_000_000
_RATES = (
    "stable_rate",
    "stable_rate_10cm_0.1rad",
    "stable_rate_5cm_drop_5deg",
    "floating_rate",
    "at_rest_rate",
)
_NUMBERS = ("scale_uncertainty", "spawn_penetration_mm", "n_dynamic", "n_base")
_CLAUSES = re.compile(r"\b(CHECK|GENERATED|VIRTUAL|AS)\b", re.IGNORECASE)


@dataclass(frozen=True)
class SceneRow:
    """A row of the index; the fields are the columns, in order. `SceneRecord` adds the path."""

    scene_id: str
    revision: str
    schema_version: str
    created_utc: str  # ISO 8601, seconds, with offset
    source_file: str
    source_sha256: str
    n_objects: int
    status: str  # "stable" | "unstable" | "unchecked"
    metrics: dict[str, Any]  # JSON values


def is_revision(value: Any) -> bool:
    """Return whether a value is a revision: 16 hexadecimal digits."""
    return isinstance(value, str) and _REVISION.fullmatch(value) is not None


def are_scene_ids(values: list[Any]) -> bool:
    """Return whether all values are valid scene ids: `is_scene_id` of each, much faster for many."""
    return _all_match(_SCENE_IDS, values)


def are_revisions(values: list[Any]) -> bool:
    """Return whether all values are revisions: `is_revision` of each, much faster for many."""
    return _all_match(_REVISIONS, values)


def _all_match(lines: re.Pattern[str], values: list[Any]) -> bool:
    """Return whether all values are texts of one line that match; the pattern is of all lines, each with its end."""
    try:
        text = "\n".join([*values, ""])
    except TypeError:  # one is no text
        return False
    return text.count("\n") == len(values) and lines.fullmatch(text) is not None


def row_of(values: tuple[Any, ...]) -> SceneRow:
    """Return the row of nine stored columns.

    Raises:
        BundleError: A value is not of its kind; names the scene and the column.
    """
    scene_id, *rest, metrics = values
    if not is_scene_id(scene_id):
        raise BundleError(f"registry: a row of the index has the scene id {ascii(scene_id)[:80]}")
    for (name, is_valid), value in zip(_COLUMNS, rest, strict=True):
        if not is_valid(value):
            raise BundleError(f"scene {scene_id}: its row of the index has the {name} {ascii(value)[:80]}")
    revision, version, created, source, digest, count, status = rest
    return SceneRow(
        scene_id, revision, version, created, source, digest, count, status, _metrics(scene_id, metrics)
    )


def _metrics(scene_id: str, text: Any) -> dict[str, Any]:
    found: Any = None
    if isinstance(text, str) and len(text) <= _MAX_METRICS:
        try:
            found = _DECODER.decode(text)
        except (ValueError, RecursionError):
            found = None
    if not isinstance(found, dict):
        raise BundleError(f"scene {scene_id}: the metrics in its row of the index are no JSON object")
    for key, value in cast("dict[str, Any]", found).items():
        number = _is_number(value)
        valid = value is None or isinstance(value, bool) or number or _is_line(value)
        if key in _RATES:
            valid = value is None or (number and 0 <= value <= 1)
        elif key in _NUMBERS:
            valid = value is None or number
        if not valid or not is_plain(key):
            raise BundleError(
                f"scene {scene_id}: its row of the index has {ascii(key)[:80]}: {ascii(value)[:80]}"
            )
    return cast("dict[str, Any]", found)


def _is_number(value: Any) -> bool:
    return type(value) in (int, float) and abs(value) <= 1e300 and math.isfinite(value)


def _is_line(value: Any) -> bool:
    return isinstance(value, str) and len(value) <= _MAX_TEXT and is_plain(value)


_COLUMNS: tuple[tuple[str, Callable[[Any], bool]], ...] = (  # between the scene id and the metrics
    ("revision", is_revision),
    ("schema_version", _is_line),
    ("created_utc", _is_line),
    ("source_file", _is_line),
    ("source_sha256", lambda value: isinstance(value, str) and _SHA256.fullmatch(value) is not None),
    ("n_objects", lambda value: type(value) is int and 0 <= value <= _MAX_OBJECTS),
    ("status", lambda value: value in _STATUS),
)


def _no_constant(name: str) -> None:
    raise ValueError(name)


_DECODER = json.JSONDecoder(parse_constant=_no_constant)


def row_of_scene(scene: dict[str, Any], revision: str, scene_id: str, created_utc: str) -> SceneRow:
    """Return the row of a valid scene.json."""
    physics = scene["report"].get("physics", {})
    rate = physics.get("stable_rate")
    known = isinstance(rate, int | float) and not isinstance(rate, bool)
    metrics = {key: value for key, value in physics.items() if _fits_index(key, value)}
    metrics["scale_method"] = scene["scale"]["method"]
    metrics["scale_uncertainty"] = scene["scale"].get("uncertainty")
    metrics["n_dynamic"] = sum(item["dynamic"] for item in scene["objects"])
    metrics["n_base"] = len(scene["base"])
    return SceneRow(
        scene_id=scene_id,
        revision=revision,
        schema_version=scene["schema"],
        created_utc=created_utc,
        source_file=scene["source"]["file"],
        source_sha256=scene["source"]["sha256"],
        n_objects=len(scene["objects"]),
        status=("stable" if rate >= 1 else "unstable") if known else "unchecked",
        metrics=metrics,
    )


def _fits_index(key: str, value: Any) -> bool:
    """Return whether a value of the physics report is one that the index takes."""
    if not is_plain(key) or len(key) > 100:
        return False
    return isinstance(value, bool | float | str) or (isinstance(value, int) and abs(value) < 2**53)


def check_schema(connection: sqlite3.Connection, path: Path) -> None:
    """Check that an index has plain tables only: a view or an expression could run without end or hold anything.

    Raises:
        BundleError: It has a view, a trigger, a virtual table, or a column that is computed or checked.
    """
    for kind, name, sql in connection.execute("SELECT type, name, sql FROM sqlite_master LIMIT 1000"):
        # SQLite's own indexes of primary keys and unique columns have no text.
        if kind not in ("table", "index") or (sql is not None and _CLAUSES.search(str(sql))):
            raise BundleError(
                f"registry: the index {path} has {ascii(kind)[:20]} {ascii(name)[:60]}, which simrecon never writes; "
                "rename it and run `simrecon registry rebuild`"
            )
