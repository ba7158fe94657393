"""Entries of an overrides file about the whole scene: `scale`, `up` and `floor`."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from reconstruction.editing.addresses import Address, is_number, parse_address, vector
from registry.errors import UsageError

SCENE_KEYS = ("scale", "up", "floor")
_LONGEST_M = 1000.0
_CLICK = "`pixel: {frame: N, x: X, y: Y}`"


@dataclass(frozen=True)
class KnownLength:
    """A measured length between two points of the scene."""

    start: Address
    end: Address
    metres: float


@dataclass(frozen=True)
class KnownUp:
    """The up direction: by clicks on level surface, or itself."""

    level: tuple[
        Address, ...
    ] = ()  # one click: the surface there is level; three or more: they are equally high
    normal: tuple[float, float, float] | None = None
    frame: int | None = None  # `normal` is in the axes of this frame's camera; None: of the uncorrected world


@dataclass(frozen=True)
class SceneEntries:
    """Entries of an overrides file about the whole scene; None: no such entry."""

    scale: KnownLength | None = None
    up: KnownUp | None = None
    floor: Address | None = None


def parse_scene_entries(entries: list[dict], where: str) -> SceneEntries:
    """Parse the entries with `scale`, `up` or `floor`; each may come once.

    Raises:
        UsageError: one is malformed, or comes twice; the message starts with `where`.
    """
    merged: dict = {}
    for entry in entries:
        twice = sorted(set(entry) & set(merged))
        if twice:
            raise UsageError(f"{where}: {twice[0]} comes twice; a scene has one, keep one of these entries")
        merged |= {key: entry[key] for key in SCENE_KEYS if key in entry}
    return parse_scene_entry(merged, where)


def parse_scene_entry(entry: dict, where: str) -> SceneEntries:
    """Parse one entry with `scale`, `up` or `floor`.

    Raises:
        UsageError: it is malformed, or addresses a thing; the message starts with `where`.
    """
    others = sorted(map(str, set(entry) - set(SCENE_KEYS)))
    if others:
        named = next(key for key in SCENE_KEYS if key in entry)
        raise UsageError(
            f"{where}: {named} is about the whole scene; take {', '.join(others)} out of this entry (an entry of its "
            "own may have it)"
        )
    return SceneEntries(
        _length(entry["scale"], f"{where}: scale") if "scale" in entry else None,
        _up(entry["up"], f"{where}: up") if "up" in entry else None,
        _click(entry["floor"], f"{where}: floor") if "floor" in entry else None,
    )


def _length(value: Any, where: str) -> KnownLength:
    if not isinstance(value, dict) or set(value) != {"from", "to", "metres"}:
        raise UsageError(f"{where} needs {{from: CLICK, to: CLICK, metres: 0.74}}, got {value!r}")
    metres = value["metres"]
    if not is_number(metres) or not 0 < metres <= _LONGEST_M:
        raise UsageError(f"{where}: metres must be a positive number (74 cm is 0.74), got {metres!r}")
    start, end = _click(value["from"], f"{where}: from"), _click(value["to"], f"{where}: to")
    if start == end:
        raise UsageError(f"{where}: from and to are the same point; choose two that are far apart")
    return KnownLength(start, end, float(metres))


def _up(value: Any, where: str) -> KnownUp:
    keys = set(value) if isinstance(value, dict) else set()
    if keys == {"level"}:
        clicks = value["level"] if isinstance(value["level"], list) else [value["level"]]
        if len(clicks) in (0, 2):
            raise UsageError(f"{where}: level needs one click, or three or more, got {len(clicks)}")
        return KnownUp(level=tuple(_click(click, f"{where}: level") for click in clicks))
    if "normal" not in keys or not keys <= {"normal", "frame"}:
        raise UsageError(
            f"{where} needs {{level: CLICK}}, {{level: [CLICK, CLICK, CLICK]}} or {{normal: [x, y, z]}} (with "
            f"`frame: N` in the axes of that frame's camera), got {value!r}"
        )
    normal = vector(value["normal"], f"{where}: normal")
    if np.linalg.norm(normal) < 1e-9:
        raise UsageError(f"{where}: normal {value['normal']!r} has no direction")
    frame = value.get("frame")
    if frame is not None and (not isinstance(frame, int) or isinstance(frame, bool) or frame < 0):
        raise UsageError(f"{where}: frame must be the number of a video frame, got {frame!r}")
    return KnownUp(normal=normal, frame=frame)


def _click(value: Any, where: str) -> Address:
    """Parse an address that must be a click: ids and metres come after the world frame that it determines."""
    if isinstance(value, int) or (isinstance(value, dict) and set(value) & {"at", "id"}):
        raise UsageError(
            f"{where} needs a click, {_CLICK}: ids and `at` count in the world frame that this entry changes; "
            f"got {value!r}"
        )
    if not isinstance(value, dict) or set(value) != {"pixel"}:
        raise UsageError(f"{where} needs a click, {_CLICK}, got {value!r}")
    return parse_address(value, where)
