"""Flat objects on walls, such as pictures, from outlines: their box on the wall, and their pixels."""

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from reconstruction.core.types import BaseEntity, DepthMaps, Instance, InstanceSet, PosedFrames
from reconstruction.instances.outlined_box import Wall, WallMask, fit_box, silhouette

_ON_WALL = 0.6  # least share of the ring around an outline that is the wall, as in `instances.outlined`
_BEFORE = 0.96  # of the wall's depth: what is nearer is in front of it, as in `instances.outlined`


def wall_around(found: InstanceSet, rings: Sequence[np.ndarray]) -> BaseEntity | None:
    """Return the wall that most of the surface around each outline belongs to; None if there is none.

    Args:
        found: the instances.
        rings: for each outline, bool (v,) vertices that are seen around it.
    """
    owner = np.asarray(found.vertex_instance)
    for base in found.base:
        if base.label == "wall" and all(
            (owner[ring] == base.id).sum() > _ON_WALL * ring.sum() for ring in rings
        ):
            return base
    return None


def hung_on(
    found: InstanceSet, base: BaseEntity, outlines: Sequence[tuple[np.ndarray, np.ndarray]], number: int, label: str,
    posed: PosedFrames, depth: DepthMaps,
) -> InstanceSet | None:  # fmt: skip
    """Return the instances with one more object, whose box lies on a wall as its outlines show it.

    Args:
        found: the instances.
        base: the wall.
        outlines: for each, its polygon (k, 2) in pixels at depth resolution, and world_from_camera (4, 4).
        number: id of the object.
        label: its label.
        posed: keyframes in world space; the box is drawn into their id maps.
        depth: their depth maps, metres.

    Returns:
        The instances; None if an outline is tiny, or a ray through it misses the wall.
    """
    wall, camera = Wall.of(base), depth.camera
    masks = []
    for polygon, pose in outlines:
        mask = np.zeros((camera.height, camera.width), np.uint8)
        cv2.fillPoly(mask, [np.round(polygon).astype(np.int32)], 1)
        masks.append(WallMask.of(mask > 0, wall, camera, pose))
    known = [mask for mask in masks if mask is not None]
    if len(known) < len(masks):
        return None
    box = fit_box(wall, known)
    middle = wall.points((0.5 * (box.low + box.high))[None], 0.5 * box.front)[0]
    extents = np.array([box.front, *box.size])
    item = Instance(number, label, 1.0, middle, wall.yaw, extents, wall.id, True)
    maps = np.array(found.id_maps)
    for ids, z, pose in zip(maps, depth.depth, posed.world_from_camera):
        shape = silhouette(box, wall, camera, np.asarray(pose, np.float64))
        if shape is not None:
            before = (np.asarray(z) > 0) & (z < _BEFORE * wall.depth(camera, pose) - box.front)
            ids[shape & np.isin(ids, [0, wall.id]) & ~before] = number
    return replace(found, id_maps=maps, objects=(*found.objects, item))
