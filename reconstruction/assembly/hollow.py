"""Where the collision shape of one thing fills the place of another: that place is cut out of it.

The convex pieces of a large thing span the niches in it and the air above it: of a counter four metres long they reach
15 cm beyond its surface. What was seen to stand there proves that the place is not the counter's.
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

_GAP_M = 2e-4  # left around the thing
_FILLS_AIR = 0.5  # of the overlap that is within the visible surface: with less, the pieces are what is wrong


@dataclass(frozen=True)
class _Place:
    """An upright prism around what is in a piece: normals . x <= levels, in the space of the piece."""

    piece: ConvexPart
    normals: np.ndarray  # (10, 3) unit
    levels: np.ndarray  # (10,) metres
    points: np.ndarray  # (n, 3) corners of what is in the piece


def hollowed(
    other: Placement, item: Placement, tolerance_m: float, clearance_m: float = 0.0
) -> tuple[ConvexPart, ...]:
    """Cut the place of a thing out of the pieces of another one: what is left of these.

    The place is the octagonal prism, in the thing's own axes, around those of its pieces that are in the other's
    piece. Below and above it the piece is whole, so that it carries what it carried.

    Args:
        other: whose pieces fill the place.
        item: who is there.
        tolerance_m: overlap that counts as touching.
        clearance_m: by how much the place is larger than the thing on all sides.
    """
    places = {id(place.piece): place for place in _places(other, item, tolerance_m, clearance_m)}
    left: tuple[ConvexPart, ...] = ()
    for piece in other.parts:
        left += _around(places[id(piece)]) if id(piece) in places else (piece,)
    return left


def fills_air(other: Placement, item: Placement, tolerance_m: float) -> bool:
    """Tell whether the pieces of a thing are in another one where its own visible surface is not."""
    places = _places(other, item, tolerance_m, 0.0)
    visual = other.asset.visual
    body = manifold_of(Solid(np.asarray(visual.vertices, np.float64), np.asarray(visual.faces)))
    if body is None or not places:
        return False
    both = [_hull(np.asarray(place.piece.vertices)) ^ _hull(place.points) for place in places]
    common = sum(part.volume() for part in both)
    return common > 0 and sum((part ^ body).volume() for part in both) < _FILLS_AIR * common


def volume(parts: tuple[ConvexPart, ...]) -> float:
    """Return the volume of pieces, one by one, in cubic metres."""
    return sum(_hull(np.asarray(part.vertices)).volume() for part in parts)


def _places(other: Placement, item: Placement, tolerance_m: float, clearance_m: float) -> list[_Place]:
    """Return the place of a thing in each of the other's pieces that it is in."""
    other_from_item = np.linalg.inv(other.pose) @ item.pose
    ours = [in_world(part, item.pose) for part in item.parts]
    found = []
    for piece in other.parts:
        their = in_world(piece, other.pose)
        overlaps = [overlap_of(our, their, sideways_only=False, clearance_m=clearance_m) for our in ours]
        inside = [
            part for part, one in zip(item.parts, overlaps) if one is not None and one.depth > tolerance_m
        ]
        if inside:
            points = np.concatenate([np.asarray(part.vertices, np.float64) for part in inside])
            levels = (points @ _WAYS.T).max(axis=0) + clearance_m + _GAP_M
            normals = _WAYS @ other_from_item[:3, :3].T
            moved = transform_points(other_from_item, points)
            found.append(_Place(piece, normals, levels + normals @ other_from_item[:3, 3], moved))
    return found


def _around(place: _Place) -> tuple[ConvexPart, ...]:
    """Return the parts of a piece around a place; the piece itself where it is not in it after all."""
    out: tuple[ConvexPart, ...] = ()
    rest: tuple[ConvexPart, ...] = (place.piece,)
    for normal, level in zip(place.normals, place.levels):
        out += cut(rest, normal, -level)
        rest = cut(rest, -normal, level)
        if not rest:
            return (place.piece,)
    return out


def _ways() -> np.ndarray:
    """Return below, above, four sides and the four between them, (10, 3)."""
    turn = np.arange(8) * np.pi / 4
    around = np.stack([np.cos(turn), np.sin(turn), np.zeros(8)], axis=1)
    return np.concatenate([[[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]], around[::2], around[1::2]])


_WAYS = _ways()


def _hull(points: np.ndarray) -> "manifold3d.Manifold":
    import manifold3d

    return manifold3d.Manifold.hull_points(np.asarray(points, np.float64))
