# pyright: strict, reportUnknownMemberType=false, reportUnknownArgumentType=false, reportUnknownVariableType=false
"""Check `report` of a scene.json: the types of all that `simrecon list`, `show` and `report` read."""

import re
from typing import Any

from registry import values
from registry.plain_text import is_plain
from registry.values import JsonObject

MAX_FIGURE = 1e12  # bounds times, sizes, energies and counts
_HEX = re.compile(r"[0-9a-f]{8,64}")
_RATES = (
    "stable_rate",
    "stable_rate_10cm_0.1rad",
    "stable_rate_5cm_drop_5deg",
    "floating_rate",
    "at_rest_rate",
)
_SIZES = ("spawn_penetration_mm", "energy_at_rest_j", "duration_s")
_COUNTS = ("dynamic_objects", "fixed_objects")
_CARD = (
    *_RATES[:4],
    "spawn_penetration_mm",
    "duration_s",
    "timestep_s",
    *_COUNTS,
)  # read where `objects` is there
_OBJECT_NUMBERS = ("moved_m", "turned_deg", "drop_m")
_OBJECT_FLAGS = ("stable", "stable_10cm_0.1rad", "stable_5cm_drop_5deg", "floating")
_CONTACT_COUNTS = ("support_edges", "support_edges_real", "attached_edges", "attached_edges_real")


def check_report(report: JsonObject) -> None:
    """Check `report`; keys that nothing reads are allowed.

    Raises:
        BundleError: Names the first invalid place, the expected and the found value.
    """
    for key in ("physics", "timings_s", "backends", "config"):
        if key in report:
            values.mapping(report[key], f"report.{key}")
    _physics(report.get("physics", {}), "report.physics")
    _figures(report.get("timings_s", {}), "report.timings_s")
    _texts(report.get("backends", {}), "report.backends")
    if report.get("peak_memory_mb") is not None:
        values.number(report, "peak_memory_mb", "report", low=0, high=MAX_FIGURE)
    if "notes" in report:
        _lines(report, "notes", "report")
    if "overrides" in report:
        for i, item in enumerate(values.sequence(report["overrides"], "report.overrides", 100_000)):
            values.mapping(item, f"report.overrides[{i}]")
    if "registration" in report:
        found = values.mapping(report["registration"], "report.registration")
        for key in ("registered", "keyframes"):
            values.integer(found, key, "report.registration", low=0)
        values.number(found, "reprojection_error_px", "report.registration", low=0, high=MAX_FIGURE)
    if "volatile" in report:
        _volatile(values.mapping(report["volatile"], "report.volatile"))


def _physics(physics: JsonObject, where: str) -> None:
    for key in _RATES:
        if key in physics:
            values.number(physics, key, where, low=0, high=1)
    for key in _SIZES:
        if key in physics:
            values.number(physics, key, where, low=0, high=MAX_FIGURE)
    for key in _COUNTS:
        if key in physics:
            values.integer(physics, key, where, low=0)
    if "timestep_s" in physics:
        values.number(physics, "timestep_s", where, low=1e-9, high=MAX_FIGURE)
    for key in ("spawn_penetration_between", "without_collision"):
        if key in physics:
            _lines(physics, key, where)
    if "contacts" in physics:
        _contacts(values.mapping(physics["contacts"], f"{where}.contacts"), f"{where}.contacts")
    if "objects" in physics:
        for key in (*_CARD, *(("energy_at_rest_j", "at_rest_rate") if "contacts" in physics else ())):
            values.get(physics, key, where)
        for i, item in enumerate(values.sequence(physics["objects"], f"{where}.objects", 10_000)):
            place = f"{where}.objects[{i}]"
            values.integer(values.mapping(item, place), "id", place)
            values.text(item, "name", place)
            for key in _OBJECT_NUMBERS:
                values.number(item, key, place, low=-MAX_FIGURE, high=MAX_FIGURE)
            for key in _OBJECT_FLAGS:
                values.boolean(item, key, place)
    for key, value in physics.items():
        if isinstance(value, str):
            values.check_line(value, f"{where}.{key}")


def _contacts(contacts: JsonObject, where: str) -> None:
    for key in _CONTACT_COUNTS:
        values.integer(contacts, key, where, low=0)
    for key in ("edges_without_contact", "supports_without_edge"):
        if key in contacts or key == "supports_without_edge":
            values.sequence(values.get(contacts, key, where), f"{where}.{key}", 10_000)


def _volatile(volatile: JsonObject) -> None:
    where = "report.volatile"
    for key in ("cpu_s", "stage_peak_memory_mb"):
        if key in volatile:
            _figures(values.mapping(volatile[key], f"{where}.{key}"), f"{where}.{key}")
    if "cached" in volatile:
        _lines(volatile, "cached", where)
    if "versions" in volatile:
        _texts(values.mapping(volatile["versions"], f"{where}.versions"), f"{where}.versions")
    for key in ("machine", "commit"):
        if volatile.get(key) is not None:
            values.text(volatile, key, where, empty=True)
    if volatile.get("work"):
        work = values.mapping(volatile["work"], f"{where}.work")
        _hex(values.get(work, "input_digest", f"{where}.work"), f"{where}.work.input_digest")
        keys = values.mapping(values.get(work, "stage_keys", f"{where}.work"), f"{where}.work.stage_keys")
        for stage, key in keys.items():
            _hex(key, f"{where}.work.stage_keys.{_key(stage, f'{where}.work.stage_keys')}")


def _hex(value: Any, place: str) -> None:
    """Check the name of a folder of stage results: it becomes a part of a path."""
    if not isinstance(value, str) or not _HEX.fullmatch(value):
        values.fail(place, "8 to 64 hexadecimal digits", value)


def _key(key: str, place: str) -> str:
    if len(key) > 200 or not is_plain(key):
        values.fail(place, "keys of one line without control characters", key)
    return key


def _figures(mapping: JsonObject, where: str) -> None:
    for key in mapping:
        values.number(mapping, _key(key, where), where, low=0, high=MAX_FIGURE)


def _texts(mapping: JsonObject, where: str) -> None:
    for key in mapping:
        values.text(mapping, _key(key, where), where, empty=True)


def _lines(mapping: JsonObject, key: str, where: str) -> None:
    for i, item in enumerate(values.sequence(mapping[key], f"{where}.{key}", 100_000)):
        values.check_line(item, f"{where}.{key}[{i}]")
