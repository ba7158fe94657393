"""Floor, walls and ceiling as the surface stage found them, as entities; a floor is assumed where none was seen."""

import numpy as np

from reconstruction.core.progress import Progress
from reconstruction.core.types import BaseEntity, Plane, Surface
from reconstruction.surface.base_planes import FittedPlane

BASE_LABELS = ("floor", "wall", "ceiling")


def base_planes(surface: Surface) -> list[FittedPlane]:
    """Return the surface's floor (first, if seen), walls and ceiling with masks of the vertices on them."""
    out = []
    for plane in surface.planes:
        if plane.label in BASE_LABELS:
            members = np.zeros(len(surface.vertices), bool)
            members[plane.vertices] = True
            out.append(FittedPlane(plane.label, plane.surface.plane, plane.band_m, members))
    return out


def base_entities(surface: Surface, progress: Progress) -> tuple[BaseEntity, ...]:
    """Return the entities of floor, walls and ceiling, numbered from 1, the floor first."""
    planes = [plane for plane in surface.planes if plane.label in BASE_LABELS]
    base: list[BaseEntity] = []
    if not planes or planes[0].label != "floor":
        progress.note("No floor was seen near z = 0: one is assumed under everything.")
        base.append(assumed_floor(1, np.asarray(surface.vertices, np.float64)))
    for plane in planes:
        base.append(BaseEntity(len(base) + 1, plane.label, plane.surface, True))
    return tuple(base)


def assumed_floor(number: int, points: np.ndarray) -> BaseEntity:
    """Return a floor at z = 0 under everything, marked as not observed."""
    if len(points):
        low, high = np.percentile(points[:, :2], [0.5, 99.5], axis=0)
    else:
        low, high = np.full(2, -1.0), np.full(2, 1.0)
    low, high = low - 0.25, high + 0.25
    corners = np.array(
        [[low[0], low[1], 0], [high[0], low[1], 0], [high[0], high[1], 0], [low[0], high[1], 0]]
    )
    return BaseEntity(number, "floor", Plane(np.array([0, 0, 1.0, 0]), corners), False)
