"""Depth maps without the virtual images of mirrors: a pixel that shows a mirror gets the depth of its glass."""

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from reconstruction.core.types import DepthMaps, Plane

_COMPLETED = 1  # confidence of a depth that comes from a plane
_BEHIND = 0.01  # of the glass' depth: what is farther is behind the glass


def without_reflections(
    depth: "DepthMaps", world_from_camera: np.ndarray, mirrors: Sequence["Plane"]
) -> "DepthMaps":
    """Return depth maps in which pixels that look behind a mirror, or have no depth there, lie on its glass.

    Args:
        depth: depth maps.
        world_from_camera: (n, 4, 4) poses of the maps, in the units of the depth.
        mirrors: glass planes with rectangular outlines, in the space of the poses.
    """
    if not mirrors:
        return depth
    rays = depth.camera.pixel_rays()
    z, confidence = np.array(depth.depth), np.array(depth.confidence)
    for row, pose in enumerate(world_from_camera):
        for mirror in mirrors:
            glass = glass_depth(mirror, rays, pose)
            behind = (glass > 0) & ((z[row] <= 0) | (z[row] > (1 + _BEHIND) * glass))
            z[row][behind] = glass[behind]
            confidence[row][behind] = _COMPLETED
    return replace(depth, depth=z, confidence=confidence)


def glass_depth(mirror: "Plane", rays: np.ndarray, world_from_camera: np.ndarray) -> np.ndarray:
    """Return the z-depth float32 (h, w) at which rays meet a mirror; 0 where they miss its outline.

    Args:
        mirror: the plane; its outline has four corners, in order, that make a rectangle.
        rays: (h, w, 3) rays of the camera, z = 1.
        world_from_camera: (4, 4) pose.
    """
    normal, offset = mirror.plane[:3], mirror.plane[3]
    directions = rays @ world_from_camera[:3, :3].T
    eye = world_from_camera[:3, 3]
    height, towards = float(eye @ normal + offset), -directions @ normal
    z = np.where((towards > 1e-6) & (height > 0), height / np.maximum(towards, 1e-6), 0.0)
    corner = mirror.polygon[0]
    points = eye + z[..., None] * directions - corner
    inside = z > 0
    for end in (mirror.polygon[1], mirror.polygon[3]):
        side = end - corner
        along = points @ side / (side @ side)
        inside &= (along >= 0) & (along <= 1)
    return np.where(inside, z, 0.0).astype(np.float32)
