"""Base entities: floor, walls and ceiling from the planes that the surface stage fitted."""

import numpy as np

from reconstruction.core.progress import Progress
from reconstruction.core.types import BaseEntity, Plane, Surface
from reconstruction.surface.base_planes import FittedPlane

BASE_LABELS = ("floor", "wall", "ceiling")


def base_planes(surface: Surface) -> list[FittedPlane]:
    """Return floor (first, if it was seen), walls and ceiling of a surface, with masks of the vertices on them."""
    out = []
    for plane in surface.planes:
        if plane.label in BASE_LABELS:
            members = np.zeros(len(surface.vertices), bool)
            members[plane.vertices] = True
            out.append(FittedPlane(plane.label, plane.surface.plane, plane.band_m, members))
    return out


def base_entities(surface: Surface, progress: Progress) -> tuple[BaseEntity, ...]:
    """Return floor, walls and ceiling, numbered from 1, the floor first; a floor is assumed where none was seen."""
    planes = [plane for plane in surface.planes if plane.label in BASE_LABELS]
    base: list[BaseEntity] = []
    if not planes or planes[0].label != "floor":
        progress.note("No floor was seen near z = 0: one is assumed under the whole scene.")
        base.append(assumed_floor(1, np.asarray(surface.vertices, np.float64)))
    for plane in planes:
        base.append(BaseEntity(len(base) + 1, plane.label, plane.surface, True))
    return tuple(base)


def assumed_floor(number: int, points: np.ndarray) -> BaseEntity:
    """Return a floor at z = 0 that extends 0.25 m beyond points (n, 3), marked as not observed."""
    if len(points):
        low, high = np.percentile(points[:, :2], [0.5, 99.5], axis=0)
    else:
        low, high = np.full(2, -1.0), np.full(2, 1.0)
    (x0, y0), (x1, y1) = low - 0.25, high + 0.25
    corners = np.array([[x0, y0, 0], [x1, y0, 0], [x1, y1, 0], [x0, y1, 0]])
    return BaseEntity(number, "floor", Plane(np.array([0, 0, 1.0, 0]), corners), False)
