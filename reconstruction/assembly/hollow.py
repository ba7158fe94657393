"""Hollow out collision shapes where they fill the place of another object.

The convex parts of a large object span its niches and the air above it: those of a counter four metres long reach 15 cm
beyond its surface. An object seen there shows that the place is free.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from reconstruction.assembly.collision import cut
from reconstruction.assembly.collision_trimming import in_world, overlap_of
from reconstruction.assembly.placement import Placement
from reconstruction.assets.solid import Solid, manifold_of
from reconstruction.core.types import ConvexPart
from registry.geometry import transform_points

if TYPE_CHECKING:
    import manifold3d

_GAP_M = 2e-4  # left around the object
_FILLS_AIR = 0.5  # share of the overlap inside of the visible surface below which the parts fill air


@dataclass(frozen=True)
class _Place:
    """An upright prism around the intruding parts: normals . x <= levels, in the space of `part`."""

    part: ConvexPart
    normals: np.ndarray  # (10, 3) unit
    levels: np.ndarray  # (10,) metres
    points: np.ndarray  # (n, 3) vertices of the intruding parts


def hollowed(
    other: Placement, item: Placement, tolerance_m: float, clearance_m: float = 0.0
) -> tuple[ConvexPart, ...]:
    """Cut the place of `item` out of the parts of `other`; return the parts left.

    The place is the octagonal prism, in the item's axes, around those of its parts that overlap the other's part. The
    part stays whole below and above it, and supports what it supported.

    Args:
        other: the object whose parts fill the place.
        item: the object in the place.
        tolerance_m: depth that counts as contact.
        clearance_m: margin of the place around the item.
    """
    places = {id(place.part): place for place in _places(other, item, tolerance_m, clearance_m)}
    left: tuple[ConvexPart, ...] = ()
    for part in other.parts:
        left += _around(places[id(part)]) if id(part) in places else (part,)
    return left


def fills_air(other: Placement, item: Placement, tolerance_m: float) -> bool:
    """Tell whether the overlap of `other` with `item` is mostly outside of the visible surface of `other`."""
    places = _places(other, item, tolerance_m, 0.0)
    visual = other.asset.visual
    body = manifold_of(Solid(np.asarray(visual.vertices, np.float64), np.asarray(visual.faces)))
    if body is None or not places:
        return False
    both = [_hull(np.asarray(place.part.vertices)) ^ _hull(place.points) for place in places]
    common = sum(part.volume() for part in both)
    return common > 0 and sum((part ^ body).volume() for part in both) < _FILLS_AIR * common


def volume(parts: tuple[ConvexPart, ...]) -> float:
    """Return the sum of the volumes of parts, cubic metres."""
    return sum(_hull(np.asarray(part.vertices)).volume() for part in parts)


def _places(other: Placement, item: Placement, tolerance_m: float, clearance_m: float) -> list[_Place]:
    """Return the place of the item in each part of `other` that it overlaps."""
    other_from_item = np.linalg.inv(other.pose) @ item.pose
    ours = [in_world(part, item.pose) for part in item.parts]
    found = []
    for part in other.parts:
        their = in_world(part, other.pose)
        overlaps = [overlap_of(our, their, sideways_only=False, clearance_m=clearance_m) for our in ours]
        inside = [p for p, one in zip(item.parts, overlaps) if one is not None and one.depth > tolerance_m]
        if inside:
            points = np.concatenate([np.asarray(p.vertices, np.float64) for p in inside])
            levels = (points @ _WAYS.T).max(axis=0) + clearance_m + _GAP_M
            normals = _WAYS @ other_from_item[:3, :3].T
            moved = transform_points(other_from_item, points)
            found.append(_Place(part, normals, levels + normals @ other_from_item[:3, 3], moved))
    return found


def _around(place: _Place) -> tuple[ConvexPart, ...]:
    """Split a part around its place; returned whole if they do not overlap after all."""
    out: tuple[ConvexPart, ...] = ()
    rest: tuple[ConvexPart, ...] = (place.part,)
    for normal, level in zip(place.normals, place.levels):
        out += cut(rest, normal, -level)
        rest = cut(rest, -normal, level)
        if not rest:
            return (place.part,)
    return out


def _ways() -> np.ndarray:
    """Return the normals (10, 3) of the prism: below, above, four sides, the four between them."""
    turn = np.arange(8) * np.pi / 4
    around = np.stack([np.cos(turn), np.sin(turn), np.zeros(8)], axis=1)
    return np.concatenate([[[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]], around[::2], around[1::2]])


_WAYS = _ways()


def _hull(points: np.ndarray) -> "manifold3d.Manifold":
    import manifold3d

    return manifold3d.Manifold.hull_points(np.asarray(points, np.float64))
