"""The structure of a room: measured surface of no object and no base plane, as one static body.

Most surface of a furnished room may be of no object that was found: a counter in pieces, a shelf that is cut off, a
wall that no plane fits. It stays in the scene, and carries objects.
"""

import numpy as np
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]

from reconstruction.core.mesh_graph import MeshGraph, pieces
from reconstruction.instances.boxes import upright_box
from reconstruction.instances.contacts import NEAR_REACH_M, UP, bottom_of, carriers, carrying, foot_of
from reconstruction.instances.cut import Cut, Shell, Thing

# Narrower strips are rims of the objects beside them, which depth smears over their outlines: half of a superpoint.
_RIM_M = 0.03
_STRIP_M = (
    0.1  # free strips up to this wide are smears along edges; 1 to 3 % of the structure of two real rooms
)
# Views that support a vertex. Of what is left in 21 generated rooms (numbers 70000 to 70061) this keeps 67 % of the
# true surface and 40 % of the artifacts, the largest difference.
_LEAST_VIEWS = 6
_FLOOR_M = 0.05  # surface below this height is the floor's: rugs, and its noise
_AROUND = 0.25  # least share of a foot with structure beside it: one side of four, the others at walls


def find_structure(shell: Shell, cut: Cut, weights: np.ndarray, least_area_m2: float) -> Thing | None:
    """Return the surface of no object and no base plane as a thing that carries objects; None where there is none.

    Surface in the box of an object is the object's, but for its lowest 3 cm, where its support may be. A morphological
    opening by 3 cm removes strips between what was found, and free strips narrower than 10 cm are dropped. Of the
    objects that stand on the rest, `rests_on` is set to it, in place.

    Args:
        shell: the surface graph and its base planes.
        cut: the objects, the base entity of each vertex, and artifacts, which are no structure.
        weights: float (v,) number of views that support each vertex.
        least_area_m2: connected components with less area are dropped.
    """
    taken = (cut.owner > 0) | (shell.owner > 0) | (shell.graph.points[:, 2] < _FLOOR_M)
    for thing in cut.things:
        taken |= _in_box_of(shell.graph, thing)
        taken[thing.vertices] = True
    unfit = shell.behind | (weights < _LEAST_VIEWS)
    unfit |= False if cut.artifact is None else cut.artifact
    vertices = _wide_surface(shell.graph, taken, unfit, least_area_m2)
    if not len(vertices):
        return None
    structure = Thing(vertices, is_object=False)
    _stand_on(shell.graph, cut.things, structure)
    return structure


def _in_box_of(graph: MeshGraph, thing: Thing) -> np.ndarray:
    """Return the vertices, bool (v,), in the upright box of an object: surface of its own that the cut has missed."""
    box = upright_box(graph.points[thing.vertices], graph.areas[thing.vertices])
    inside = (np.abs(box.plan_offsets(graph.points)) < 0.5 * box.extents_m[:2]).all(axis=1)
    above = graph.points[:, 2] - box.center[2] + 0.5 * box.extents_m[2]
    return inside & (above > _RIM_M) & (above < box.extents_m[2])


def _wide_surface(graph: MeshGraph, taken: np.ndarray, unfit: np.ndarray, least_area_m2: float) -> np.ndarray:
    """Return the vertices (k,) of wide connected surface that is not `taken` (v,), and not `unfit` (v,)."""
    free = np.flatnonzero(~taken & ~unfit)
    points = graph.points[free]
    core = np.ones(len(free), bool)
    if taken.any() and len(free):
        core = cKDTree(graph.points[taken]).query(points, distance_upper_bound=_RIM_M)[0] > _RIM_M
    if not core.any():
        return free[:0]
    wide = free[cKDTree(points[core]).query(points, distance_upper_bound=_RIM_M)[0] <= _RIM_M]
    parts = [part for part in pieces(graph, np.sort(wide)) if graph.areas[part].sum() >= least_area_m2]
    parts = [part for part in parts if _width_m(graph.points[part]) > _STRIP_M]
    return np.sort(np.concatenate(parts)) if parts else free[:0]


def _width_m(points: np.ndarray) -> float:
    """Return the second largest extent of points (n, 3) along their principal axes: that of a strip is its width."""
    offset = points - points.mean(axis=0)
    axes = np.linalg.eigh(offset.T @ offset)[1]
    return float(np.sort(np.ptp(offset @ axes, axis=0))[1])


def _stand_on(graph: MeshGraph, things: list[Thing], structure: Thing) -> None:
    """Put the objects without support that stand on the structure on it, in place; none of them hangs on a wall."""
    found = carriers(graph, [*(t.vertices for t in things), structure.vertices], (NEAR_REACH_M,))
    for thing, carrier in zip(things, found):
        on_it = thing.rests_on is None and carrier == len(things)
        if on_it and _beside(graph, thing, structure) >= _AROUND:
            thing.rests_on, thing.attached = structure, False


def _beside(graph: MeshGraph, thing: Thing, structure: Thing) -> float:
    """Return the share of a thing's foot with structure at its height within 5 cm in plan."""
    points, around = graph.points[thing.vertices], graph.points[structure.vertices]
    bottom = bottom_of(points)
    around = around[carrying(around, bottom) & (graph.normals[structure.vertices, 2] > UP)]
    if not len(around):
        return 0.0
    away = cKDTree(around[:, :2]).query(foot_of(points, bottom)[:, :2])[0]
    return float((away < NEAR_REACH_M).mean())
