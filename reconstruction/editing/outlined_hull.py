"""The box of an object without surface, such as a glass: the space that two outlines allow (visual hull)."""

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.optimize import linprog
from scipy.spatial import HalfspaceIntersection, QhullError  # pyright: ignore[reportAttributeAccessIssue]

from reconstruction.core.types import Camera, InstanceSet, Surface
from reconstruction.editing.outlines import Outline
from reconstruction.instances.boxes import UprightBox, upright_box
from registry.errors import UsageError

_LEAST_ANGLE_DEG = (
    15.0  # between the outlines' directions: the hull is then up to 1 / tan(7.5 deg) = 8 times too deep
)
_ROOM_M = 0.5  # the hull ends this far beyond all seen surface
_LEAST_M = 1e-4  # radius of the largest ball in the hull


@dataclass(frozen=True)
class Cone:
    """All points that project into an outline."""

    world_from_camera: np.ndarray  # (4, 4)
    polygon: np.ndarray  # (k, 2) pixels
    outline: Outline

    def axis(self, camera: Camera) -> np.ndarray:
        """Return the direction (3,) of the middle of the outline, unit, world space."""
        u, v = self.polygon.mean(axis=0)
        ray = self.world_from_camera[:3, :3] @ camera.unproject(u, v, 1.0)
        return ray / np.linalg.norm(ray)

    def halfspaces(self, camera: Camera) -> np.ndarray:
        """Return the half-spaces (k, 4), a . x + b <= 0 in world space, of the convex hull of the outline."""
        hull = cv2.convexHull(self.polygon.astype(np.float32))[:, 0].astype(np.float64)
        rays = camera.unproject(hull[:, 0], hull[:, 1], 1.0) @ self.world_from_camera[:3, :3].T
        normals = np.cross(rays, np.roll(rays, -1, axis=0))
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        normals *= -np.sign(normals @ self.axis(camera))[:, None]
        return np.column_stack([normals, -normals @ self.world_from_camera[:3, 3]])


def box_between(
    cones: list[Cone], camera: Camera, surface: Surface, found: InstanceSet, under: list[np.ndarray], label: str,
    shown: float,
) -> UprightBox:  # fmt: skip
    """Return the upright box of the space inside both cones, the room, and the seen part of the world.

    Args:
        cones: one or two; one is an error.
        camera: that the outlines count in.
        surface: the seen surface, which bounds the space.
        found: its base entities bound the space.
        under: planes (4,) that the object stands on.
        label: of the object, for errors.
        shown: share of the outlines that surface of their own fills, for errors.

    Raises:
        UsageError: there is one cone only, the two are too nearly parallel, or they do not meet.
    """
    frames = " and ".join(f"frame {cone.outline.frame}" for cone in cones)
    empty = (
        f"overrides: add {label}: the outline in {frames} has next to no surface of its own ({shown:.0%} of it; floor, "
        "walls and tops that go on beyond it do not count), as with glass and gloss"
    )
    if len(cones) < 2:
        raise UsageError(
            f"{empty}. Add its outline in a second frame, seen from another side: then it becomes a box, whose shape "
            "`mesh: FILE` replaces"
        )
    angle_deg = np.degrees(np.arccos(np.clip(cones[0].axis(camera) @ cones[1].axis(camera), -1, 1)))
    if angle_deg < _LEAST_ANGLE_DEG:
        raise UsageError(
            f"{empty}, and the two frames see it from directions only {angle_deg:.0f} degrees apart; take frames at "
            f"least {_LEAST_ANGLE_DEG:g} degrees apart"
        )
    low, high = (
        np.asarray(surface.vertices, np.float64).min(0) - _ROOM_M,
        surface.vertices.max(0) + _ROOM_M,
    )
    room = np.concatenate([np.column_stack([-np.eye(3), low]), np.column_stack([np.eye(3), -high])])
    walls = [
        -np.asarray(plane)[None] for plane in (*(b.surface.plane for b in found.base if b.observed), *under)
    ]
    halfspaces = np.concatenate([*(cone.halfspaces(camera) for cone in cones), room, *walls])
    corners = _corners(halfspaces)
    if corners is None:
        raise UsageError(
            f"{empty}, and the two outlines do not meet in space: one of them shows something else, or is not exact"
        )
    return upright_box(corners, np.ones(len(corners)))


def _corners(halfspaces: np.ndarray) -> np.ndarray | None:
    """Return the corners (n, 3) of the intersection of half-spaces; None if it is empty."""
    # Chebyshev center: the center of the largest ball inside.
    norms = np.linalg.norm(halfspaces[:, :3], axis=1)
    found = linprog(
        [0, 0, 0, -1],
        np.column_stack([halfspaces[:, :3], norms]),
        -halfspaces[:, 3],
        bounds=[(None, None)] * 3 + [(0, None)],
    )
    if found.status != 0 or found.x[3] < _LEAST_M:
        return None
    try:
        return HalfspaceIntersection(halfspaces, found.x[:3]).intersections
    except QhullError:
        return None
