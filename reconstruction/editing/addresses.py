"""Addresses of objects in an overrides file: an id, a point in the world, or a click in a frame of the film.

Ids change with settings, world coordinates change with the scale. A frame number and a pixel address the same object in
every reconstruction of a film, so that clicks suit files that are kept. See docs/overrides.md.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from registry.errors import UsageError

KINDS = ("id", "at", "pixel")


@dataclass(frozen=True)
class Address:
    """One address; the fields after `kind` that belong to other kinds keep their defaults."""

    kind: str  # one of KINDS
    id: int = 0
    near: tuple[float, float, float] | None = None  # world metres; the object of `id` must be near this point
    at: tuple[float, float, float] = (0.0, 0.0, 0.0)  # world metres
    frame: int = 0  # video frame number
    pixel: tuple[float, float] = (0.0, 0.0)  # x, y in the video as filmed, upright
    size: tuple[int, int] | None = None  # width, height that `pixel` counts in; None: the video's

    def __str__(self) -> str:
        if self.kind == "id":
            return f"id {self.id}"
        if self.kind == "at":
            return "at [" + ", ".join(f"{x:.2f}" for x in self.at) + "]"
        return f"pixel ({self.pixel[0]:g}, {self.pixel[1]:g}) of frame {self.frame}"


def parse_address(value: Any, where: str) -> Address:
    """Parse an address: a number, or a mapping with one of `id`, `at`, `pixel`; its other keys are ignored.

    Raises:
        UsageError: it is none of these; the message starts with `where`.
    """
    if isinstance(value, int) and not isinstance(value, bool):
        return Address("id", value)
    entry = value if isinstance(value, dict) else {}
    given = [kind for kind in KINDS if kind in entry]
    if len(given) != 1:
        raise UsageError(
            f"{where}: needs one of `id: N`, `at: [x, y, z]` and `pixel: {{frame: N, x: X, y: Y}}`, "
            f"got {value!r}"
        )
    if "near" in entry and given[0] != "id":
        raise UsageError(f"{where}: `near` can only be used with `id`; remove it beside `{given[0]}`")
    if given[0] == "at":
        return Address("at", at=vector(entry["at"], f"{where}: at"))
    if given[0] == "pixel":
        return _click(entry["pixel"], where)
    if not isinstance(entry["id"], int) or isinstance(entry["id"], bool):
        raise UsageError(f"{where}: id must be the number of a thing in `simrecon show`, got {entry['id']!r}")
    near = vector(entry["near"], f"{where}: near") if "near" in entry else None
    return Address("id", entry["id"], near)


def parse_addresses(values: Any, where: str, fewest: int) -> list[Address]:
    """Parse a list of at least `fewest` different addresses."""
    if not isinstance(values, list) or len(set(map(repr, values))) < fewest:
        raise UsageError(
            f"{where} needs a list of at least {fewest} different things (ids or other addresses), got {values!r}"
        )
    return [parse_address(value, where) for value in values]


def parse_parts(values: Any, where: str) -> list[list[Address]]:
    """Parse the points of a split: for each part one point (`pixel` or `at`), or a list of points."""
    if not isinstance(values, list) or len(values) < 2:
        raise UsageError(
            f"{where} needs a plane {{point: [x, y, z], normal: [x, y, z]}}, or a list with a point on each part such "
            f"as `- pixel: {{frame: 40, x: 812, y: 333}}`, got {values!r}"
        )
    parts = []
    for value in values:
        points = [parse_address(v, where) for v in (value if isinstance(value, list) else [value])]
        if not points or any(point.kind == "id" for point in points):
            raise UsageError(f"{where}: each part needs a point on it, `pixel` or `at`, got {value!r}")
        parts.append(points)
    return parts


def vector(value: Any, where: str) -> tuple[float, float, float]:
    """Parse three finite numbers."""
    listed = value.tolist() if isinstance(value, np.ndarray) else value
    if not isinstance(listed, list | tuple) or len(listed) != 3 or not all(map(is_number, listed)):
        raise UsageError(f"{where} must be three numbers, got {value!r}")
    x, y, z = map(float, listed)
    return x, y, z


def is_number(value: Any) -> bool:
    """Return whether a value is a finite number; true and false are none."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:  # a whole number of more than 308 digits
        return False


def _click(value: Any, where: str) -> Address:
    size = value.get("size") if isinstance(value, dict) else None
    if (
        not isinstance(value, dict)
        or not {"frame", "x", "y"} <= set(value) <= {"frame", "x", "y", "size"}
        or not all(is_number(value[k]) for k in ("frame", "x", "y"))
        or value["frame"] != int(value["frame"])
        or not (size is None or _is_size(size))
    ):
        raise UsageError(
            f"{where}: pixel needs {{frame: N, x: X, y: Y}}, the video's frame number and a pixel in it "
            f"(with `size: [width, height]` if x and y count in another size than the video's), got {value!r}"
        )
    pixel = float(value["x"]), float(value["y"])
    in_size = (int(size[0]), int(size[1])) if size else None
    return Address("pixel", frame=int(value["frame"]), pixel=pixel, size=in_size)


def _is_size(value: Any) -> bool:
    return (
        isinstance(value, list)
        and len(value) == 2
        and all(is_number(side) and 1 <= side <= 1e6 for side in value)
    )
