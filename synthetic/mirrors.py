"""Rooms with a wall mirror: its pixels show the room as reflected at the mirror's plane.

Light is that of the room without the mirror: no light is thrown by it.
"""

from dataclasses import dataclass, replace

import numpy as np

from registry.geometry import transform_points
from synthetic.room import NORTH_M, Entity, Room
from synthetic.shapes import Patch

GLASS = "picture/art"  # texture of the reflecting surface
_BEHIND_M = 1e-3


@dataclass(frozen=True)
class Mirror:
    """A reflecting surface of a film set."""

    texture: int  # number of the texture whose faces reflect
    plane: np.ndarray  # float64 (4,) its normal into the room


def with_wall_mirror(
    room: Room, width_m: float = 1.05, height_m: float = 1.4, bottom_m: float = 0.25
) -> Room:
    """Return a generated room whose picture is stretched to the size of a mirror, with the label "mirror"."""
    picture = room.entity("picture")
    wide, deep, high = picture.size
    center = picture.world_from_object[0, 3]
    stretch = np.diag([width_m / wide, 1.0, height_m / high, 1.0])
    stretch[0, 3] = center * (1 - stretch[0, 0])
    stretch[2, 3] = bottom_m - stretch[2, 2] * picture.world_from_object[2, 3]

    def stretched(patch: Patch) -> Patch:
        return replace(patch, vertices=transform_points(stretch, patch.vertices))

    pose = picture.world_from_object.copy()
    pose[2, 3] = bottom_m
    mirror = replace(
        picture,
        label="mirror",
        size=(width_m, deep, height_m),
        world_from_object=pose,
        solids=tuple(tuple(map(stretched, solid)) for solid in picture.solids),
        patches=tuple(map(stretched, picture.patches)),
    )
    entities: tuple[Entity, ...] = tuple(mirror if e is picture else e for e in room.entities)
    return replace(room, entities=entities)


def glass_plane(room: Room) -> np.ndarray:
    """Return the plane (4,) of the reflecting surface of `with_wall_mirror`, its normal into the room."""
    glass = [p for p in room.entity("picture").patches if p.texture == GLASS]
    front = min(float(p.vertices[:, 1].min()) for p in glass)
    assert front < NORTH_M
    return np.array([0.0, -1.0, 0.0, front])


def reflected_points(plane: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return points (n, 3) reflected at a plane (4,)."""
    return points - 2 * (points @ plane[:3] + plane[3])[:, None] * plane[:3]
