"""Furniture in a row before a wall: two pieces of it that smeared surface joins are two.

Between a shelf and the bench next to it depth sees hardly into the gap, and fills it with a sheet from one to the
other, a hand's breadth before the wall. What shows the wall there is the wall: where two large parts are left without
it, side by side along the wall, each of them is a piece of furniture.
"""

import numpy as np

from reconstruction.instances.boxes import quantiles
from reconstruction.instances.config import InstancesConfig
from reconstruction.instances.cut import Shell
from reconstruction.instances.foreign import ColorView
from reconstruction.instances.smears import shows_wall
from reconstruction.surface.base_planes import plane_axes
from reconstruction.surface.mesh_graph import MeshGraph, pieces

_LEAST_M, _PART_M = 0.6, 0.3  # of a body that may be two, and of each of them: longest extent
_DEEP_M = 0.15  # how far before the wall it is smeared
_PART_SHARE = 0.1  # of the body's area
_GROUND_M = 0.1  # each part stands on the same as the body
_MARGIN_M = 0.05  # around the gap between two parts


def bridges_along_walls(
    shell: Shell, rest: np.ndarray, view: ColorView, config: InstancesConfig
) -> list[tuple[np.ndarray, int]]:
    """Return the surface that joins furniture in a row before a wall.

    Args:
        shell: the surface and its base.
        rest: sorted vertices of what is no base.
        view: the surface, and keyframes with pictures of its walls.
        config: how wide gaps of the surface are bridged.

    Returns:
        Sorted vertices, and the base entity that they show.
    """
    graph, found = shell.graph, []
    walls = [row for row, plane in enumerate(shell.planes) if plane.label == "wall"]
    for body in pieces(graph, rest, config.bridge_gap_m):
        points = graph.points[body]
        if np.ptp(points, axis=0).max() < _LEAST_M:
            continue
        for row, picture in zip(walls, view.walls):
            near = body[shell.planes[row].distance(points) < _DEEP_M]
            shows = near[shows_wall(graph.points[near], picture, view.frames)]
            if not len(shows):
                continue
            along = graph.points @ plane_axes(shell.planes[row].plane)[0]
            for low, high in _gaps(graph, body, shows, along, config):
                between = (along[shows] > low - _MARGIN_M) & (along[shows] < high + _MARGIN_M)
                found.append((shows[between], shell.entity_id(row)))
    return found


def _gaps(
    graph: MeshGraph, body: np.ndarray, shows: np.ndarray, along: np.ndarray, config: InstancesConfig
) -> list[tuple[float, float]]:
    """Return from where to where along a wall a body has, between large parts, nothing but what shows the wall."""
    left = pieces(graph, np.setdiff1d(body, shows, assume_unique=True), config.bridge_gap_m)
    least, ground = _PART_SHARE * graph.areas[body].sum(), graph.points[body, 2].min() + _GROUND_M
    spans = sorted(
        tuple(quantiles(along[part], graph.areas[part], (0.01, 0.99)))
        for part in left
        if graph.areas[part].sum() > least
        and graph.points[part, 2].min() < ground
        and np.ptp(graph.points[part], axis=0).max() > _PART_M
    )
    gaps, reach = [], -np.inf
    for low, high in spans:
        if np.isfinite(reach) and low > reach:
            gaps.append((float(reach), float(low)))
        reach = max(reach, high)
    return gaps
