"""Mirrors on walls as objects: the glass that the world stage found, with the frame that the cut found around it."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from reconstruction.core.types import (
    BaseEntity,
    DepthMaps,
    Instance,
    InstanceSet,
    Plane,
    PosedFrames,
    Surface,
)
from reconstruction.instances.outlined import draw_box
from reconstruction.instances.outlined_box import MIN_FRONT_M, Wall, WallBox

LABEL = "mirror"
_FROM_WALL_M = 0.12  # largest distance of the glass from its wall
_PARALLEL = 0.98  # least cosine between their normals
_FRAME_M = 0.12  # width of a frame around the glass
_DEEP_M = 0.06  # how far surface lies behind the glass, or before it, that belongs to the mirror
_WITHIN = 0.6  # least share of an object's surface in the mirror's box that makes it the frame


def hang_mirrors(
    found: InstanceSet, mirrors: Sequence[Plane], surface: Surface, posed: PosedFrames, depth: DepthMaps
) -> InstanceSet:
    """Return the instances with an object for each mirror that hangs on a wall of theirs.

    Objects of the cut within its box, such as its frame, become part of it. A mirror elsewhere, such as a wardrobe's
    door, stays part of the thing that the cut found there.

    Args:
        found: the instances.
        mirrors: glass in world space, rectangles.
        surface: the surface that was segmented.
        posed: keyframes in world space.
        depth: their depth maps, metres.
    """
    for glass in mirrors:
        wall = _wall_of(glass, found.base)
        if wall is not None:
            found = _hung(found, glass, wall, surface, posed, depth)
    return found


def _wall_of(glass: Plane, base: Sequence[BaseEntity]) -> Wall | None:
    for entity in base:
        if entity.label != "wall":
            continue
        wall = Wall.of(entity)
        away = glass.polygon @ wall.normal + wall.offset
        if wall.normal @ glass.plane[:3] > _PARALLEL and np.abs(away).max() < _FROM_WALL_M:
            return wall
    return None


def _hung(
    found: InstanceSet, glass: Plane, wall: Wall, surface: Surface, posed: PosedFrames, depth: DepthMaps
) -> InstanceSet:
    places = np.column_stack([glass.polygon @ wall.along, glass.polygon[:, 2]])
    low, high = places.min(axis=0), places.max(axis=0)
    front = max(float(np.mean(glass.polygon @ wall.normal + wall.offset)), MIN_FRONT_M)
    points = np.asarray(surface.vertices, np.float64)
    along = np.column_stack([points @ wall.along, points[:, 2]])
    away = points @ wall.normal + wall.offset
    flat = np.abs(away - front) < _DEEP_M
    near = flat & ((along > low - _FRAME_M) & (along < high + _FRAME_M)).all(axis=1)
    owner = np.array(found.vertex_instance)
    parts = [o for o in found.objects if near[owner == o.id].sum() >= _WITHIN * max((owner == o.id).sum(), 1)]
    names = [o.id for o in parts]
    framed = near & np.isin(owner, names) & (away > 0.5 * front)  # without the wall's surface beside it
    if framed.any():
        edges = np.percentile(along[framed], [1, 99], axis=0)
        low, high = np.minimum(low, edges[0]), np.maximum(high, edges[1])
        front = max(front, float(np.percentile(away[framed], 90)))
    box = WallBox(low, high, front)
    number = names[0] if names else found.last_id + 1
    inside = flat & ((along >= low) & (along <= high)).all(axis=1)
    owner[inside & np.isin(owner, [0, wall.id, *names])] = number
    owner[np.isin(owner, names)] = number
    maps = np.array(found.id_maps)
    maps[np.isin(maps, names)] = number
    draw_box(maps, number, box, wall, posed, depth)
    middle = wall.points((0.5 * (low + high))[None], 0.5 * front)[0]
    item = Instance(number, LABEL, 1.0, middle, wall.yaw, np.array([front, *box.size]), wall.id, True)
    objects = tuple(o for o in found.objects if o.id not in names)
    return replace(found, vertex_instance=owner, id_maps=maps, objects=(*objects, item))
