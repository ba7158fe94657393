"""Poses that the user gives to objects: `move` of an overrides file."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from reconstruction.core.types import ObjectAsset
from reconstruction.editing.addresses import is_number, vector
from registry.errors import UsageError
from registry.geometry import matrix_from_quat, rigid, transform_points

_POSE_KEYS = ("by", "to", "turn_deg", "wxyz")
_FARTHEST_M = 100.0  # of a place from the origin, and of a shift: farther is a slip of the pen in metres
_EXAMPLES = "`move: {by: [0.1, 0, 0], turn_deg: 30}` or `move: {to: [x, y, z], wxyz: [w, x, y, z]}`"


@dataclass(frozen=True)
class Move:
    """A change of an object's pose in the world; None: not given."""

    by: tuple[float, float, float] | None = None  # metres
    to: tuple[float, float, float] | None = None  # place of the origin of its object space, metres
    turn_deg: float | None = None  # about +z through the center of its box
    wxyz: tuple[float, ...] | None = None  # world_from_object, unit quaternion
    with_carried: bool = False


def parse_move(value: Any, where: str) -> Move:
    """Parse the value of `move`.

    Raises:
        UsageError: it is malformed; the message starts with `where` and names the allowed keys.
    """
    if not isinstance(value, dict) or not set(value) & set(_POSE_KEYS):
        raise UsageError(f"{where} needs {_EXAMPLES}, got {value!r}")
    unknown = sorted(map(str, set(value) - {*_POSE_KEYS, "with_carried"}))
    if unknown:
        raise UsageError(
            f"{where}: unknown {', '.join(map(repr, unknown))}; it may have {', '.join(_POSE_KEYS)} and with_carried"
        )
    for a, b in (("by", "to"), ("turn_deg", "wxyz")):
        if a in value and b in value:
            raise UsageError(f"{where}: has {a} and {b}; keep one of the two")
    if not isinstance(value.get("with_carried", False), bool):
        raise UsageError(f"{where}: with_carried must be true or false, got {value['with_carried']!r}")
    for name in ("by", "to"):
        if name in value and np.abs(vector(value[name], f"{where}: {name}")).max() > _FARTHEST_M:
            raise UsageError(f"{where}: {name} must be within {_FARTHEST_M:g} m, got {value[name]!r}")
    if "turn_deg" in value and not is_number(value["turn_deg"]):
        raise UsageError(f"{where}: turn_deg must be a number of degrees, got {value['turn_deg']!r}")
    return Move(
        vector(value["by"], f"{where}: by") if "by" in value else None,
        vector(value["to"], f"{where}: to") if "to" in value else None,
        float(value["turn_deg"]) if "turn_deg" in value else None,
        _quaternion(value["wxyz"], f"{where}: wxyz") if "wxyz" in value else None,
        value.get("with_carried", False),
    )


def _quaternion(value: Any, where: str) -> tuple[float, ...]:
    good = isinstance(value, list) and len(value) == 4 and all(map(is_number, value))
    length = float(np.linalg.norm(value)) if good else 0.0
    if abs(length - 1) > 0.01:  # rounding to two decimals stays below this
        raise UsageError(f"{where} must be a unit quaternion [w, x, y, z], got {value!r}")
    return tuple(float(x) / length for x in value)


def moved(item: ObjectAsset, move: Move) -> ObjectAsset:
    """Return the object at its new pose.

    Its support hint is dropped if it changes place: what carried it there need not carry it here.
    """
    pose = item.world_from_object
    center = _box_center(item)
    if move.wxyz is not None:
        pose = rigid(matrix_from_quat(np.array(move.wxyz)), pose[:3, 3])
    if move.turn_deg is not None:
        pose = turned(pose, move.turn_deg, center)
    if move.by is not None:
        pose = rigid(pose[:3, :3], pose[:3, 3] + np.array(move.by))
    if move.to is not None:
        pose = rigid(pose[:3, :3], np.array(move.to))
    hint = item.support_hint if move.by is None and move.to is None else 0
    return replace(item, world_from_object=pose, support_hint=hint)


def turned(pose: np.ndarray, angle_deg: float, center: np.ndarray) -> np.ndarray:
    """Return a pose (4, 4) rotated about the vertical through a point (3,), counter-clockwise seen from above."""
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
    return rigid(turn @ pose[:3, :3], center + turn @ (pose[:3, 3] - center))


def carried_by(number: int, objects: Iterable[ObjectAsset]) -> set[int]:
    """Return the ids of the objects that rest on an object, directly or on one another, by their support hints."""
    items = list(objects)
    found: set[int] = set()
    while more := {o.id for o in items if o.support_hint in {number, *found}} - {number, *found}:
        found |= more
    return found


def _box_center(item: ObjectAsset) -> np.ndarray:
    points = np.asarray(item.visual.vertices, np.float64)
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    return transform_points(item.world_from_object, middle[None])[0]
