"""Outlines that the user draws in frames of the film: `add` of an overrides file."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from reconstruction.editing.addresses import Address, is_number, parse_address
from registry.errors import UsageError

_EXAMPLE = "`{label: mug, outline: {frame: 40, points: [[x, y], [x, y], [x, y]]}}`"
_MOST_OUTLINES = 2


@dataclass(frozen=True)
class Outline:
    """A polygon in a frame; its corners as clicks."""

    frame: int
    corners: tuple[Address, ...]

    def __str__(self) -> str:
        return f"the outline in frame {self.frame}"


@dataclass(frozen=True)
class Added:
    """A thing to add: its label, and its outline in one or two frames."""

    label: str
    outlines: tuple[Outline, ...]


def parse_add(value: Any, where: str) -> Added:
    """Parse the value of `add`.

    Raises:
        UsageError: it is malformed; the message starts with `where`.
    """
    if not isinstance(value, dict) or set(value) != {"label", "outline"}:
        raise UsageError(f"{where} needs {_EXAMPLE}, got {value!r}")
    label = value["label"]
    if not isinstance(label, str) or not label.strip():
        raise UsageError(f"{where}: label must be text, got {label!r}")
    given = value["outline"] if isinstance(value["outline"], list) else [value["outline"]]
    if not 1 <= len(given) <= _MOST_OUTLINES:
        raise UsageError(f"{where}: needs one or two outlines, got {len(given)}")
    outlines = tuple(_outline(item, f"{where}: outline") for item in given)
    if len({outline.frame for outline in outlines}) < len(outlines):
        raise UsageError(
            f"{where}: both outlines are in frame {outlines[0].frame}; draw the second in another one"
        )
    return Added(label, outlines)


def _outline(value: Any, where: str) -> Outline:
    keys = set(value) if isinstance(value, dict) else set()
    points = value.get("points") if isinstance(value, dict) else None
    if not {"frame", "points"} <= keys <= {"frame", "points", "size"} or not isinstance(points, list):
        raise UsageError(f"{where} needs {{frame: N, points: [[x, y], ...]}}, got {value!r}")
    if len(points) < 3 or not all(
        isinstance(p, list) and len(p) == 2 and all(map(is_number, p)) for p in points
    ):
        raise UsageError(f"{where}: points must be three or more pixels [x, y], got {points!r}")
    shared = {"frame": value["frame"], **({"size": value["size"]} if "size" in value else {})}
    corners = tuple(parse_address({"pixel": {**shared, "x": x, "y": y}}, where) for x, y in points)
    if abs(_area(np.array(points, np.float64))) < 1.0:
        raise UsageError(f"{where}: the points of frame {value['frame']} enclose nothing: {points!r}")
    return Outline(corners[0].frame, corners)


def _area(points: np.ndarray) -> float:
    """Return the signed area of a polygon (n, 2), by the shoelace formula."""
    x, y = points.T
    return float(0.5 * (x @ np.roll(y, -1) - y @ np.roll(x, -1)))
