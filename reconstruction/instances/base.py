"""Floor, walls and ceiling as the surface stage found them, as entities; a floor is assumed where none was seen."""

import numpy as np
from scipy.spatial import cKDTree

from reconstruction.instances.colors import LIGHTNESS_WEIGHT
from reconstruction.progress import Progress
from reconstruction.surface.base_planes import FittedPlane, plane_axes
from reconstruction.surface.mesh_graph import MeshGraph, pieces
from reconstruction.types import BaseEntity, Plane, Surface

BASE_LABELS = ("floor", "wall", "ceiling")
_SKIRT_M = 0.05  # how far from a base plane its noise reaches
_SKIRT_BESIDE_M = 0.06  # what is nearer than this to a part that stands out may be its foot
_SKIRT_COLOR = 12.0
_MIN_STANDING_M2 = 0.003


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


def base_skirts(
    graph: MeshGraph, rest: np.ndarray, planes: list[FittedPlane], bridge_m: float
) -> list[tuple[np.ndarray, int]]:
    """Find the base's own noise that hangs on furniture: sheets off a plane, of its color, away from what stands out.

    A piece of surface that lies near a plane as a whole is left to others: it may be a flat thing.

    Args:
        graph: the surface.
        rest: sorted vertices that belong to no base plane.
        planes: the base.
        bridge_m: pieces closer than this are looked at together.

    Returns:
        Pairs of vertices, and the number of the plane that they are of (as `base_owner` counts).
    """
    first = 1 if planes and planes[0].label == "floor" else 2
    found = []
    for piece in pieces(graph, rest, bridge_m):
        if graph.areas[piece].sum() < _MIN_STANDING_M2:
            continue
        for number, plane in enumerate(planes, start=first):
            skirt = _skirt(graph, piece, plane)
            if len(skirt):
                found.append((skirt, number))
                piece = np.setdiff1d(piece, skirt, assume_unique=True)
    return found


def _skirt(graph: MeshGraph, piece: np.ndarray, plane: FittedPlane) -> np.ndarray:
    near = plane.distance(graph.points[piece]) < _SKIRT_M
    low, standing = piece[near], piece[~near]
    if len(low) == 0 or graph.areas[standing].sum() < _MIN_STANDING_M2:
        return low[:0]
    axes = np.stack(plane_axes(plane.plane), axis=1)
    beside = cKDTree(graph.points[standing] @ axes).query(
        graph.points[low] @ axes, distance_upper_bound=_SKIRT_BESIDE_M
    )[0]
    low = low[~np.isfinite(beside)]
    members = np.flatnonzero(plane.members)
    if len(low) == 0 or len(members) == 0:
        return low
    nearest = members[cKDTree(graph.points[members]).query(graph.points[low])[1]]
    contrast = np.linalg.norm((graph.lab[low] - graph.lab[nearest]) * LIGHTNESS_WEIGHT, axis=1)
    return low[contrast < _SKIRT_COLOR]
