"""Cut a taller neighbor off a flat-topped thing that it touches from the side: a carton beside a book."""

import numpy as np
from scipy.spatial import cKDTree

from reconstruction.instances.config import InstancesConfig
from reconstruction.instances.supports import SupportRegion, contact_height
from reconstruction.surface.mesh_graph import MeshGraph, pieces


def neighbors_of(
    graph: MeshGraph, body: np.ndarray, support: SupportRegion, config: InstancesConfig
) -> list[np.ndarray]:
    """Return the parts of `body` that rise beside (not on) its flat top `support` and have another color.

    Sides of a container rise beside its bottom too, but have its color and surround it.
    """
    base = contact_height(support, config)
    out: list[np.ndarray] = []
    remaining = body
    high = body[graph.points[body, 2] > support.height_m + 2.0 * base]
    high = np.setdiff1d(high, support.vertices, assume_unique=True)
    for candidate in pieces(graph, high):
        if len(candidate) < config.min_object_vertices:
            continue
        part = _down_to_ground(graph, candidate, remaining, support)
        if _is_neighbor(graph, part, candidate, remaining, support, config):
            out.append(part)
            remaining = np.setdiff1d(remaining, part, assume_unique=True)
    return out


def _down_to_ground(
    graph: MeshGraph, candidate: np.ndarray, body: np.ndarray, support: SupportRegion
) -> np.ndarray:
    """Add what lies right below a candidate, outside the outline of the flat top."""
    low = body[graph.points[body, 2] <= graph.points[candidate, 2].min()]
    xy = graph.points[low, :2]
    distance, _ = cKDTree(graph.points[candidate, :2]).query(xy, distance_upper_bound=0.02)
    outside = ~support.footprint.contains(xy)
    return np.union1d(candidate, low[np.isfinite(distance) & outside])


def _is_neighbor(
    graph: MeshGraph,
    part: np.ndarray,
    candidate: np.ndarray,
    body: np.ndarray,
    support: SupportRegion,
    config: InstancesConfig,
) -> bool:
    rest = np.setdiff1d(body, part, assume_unique=True)
    if len(rest) < config.min_object_vertices or np.ptp(graph.points[part, 2]) < 0.04:
        return False
    if np.sort(np.ptp(graph.points[part], axis=0))[1] < config.min_object_m:
        return False
    points = graph.points[candidate]
    foot = points[points[:, 2] < points[:, 2].min() + max(0.015, 1.5 * graph.spacing_m)]
    if support.footprint.contains(foot[:, :2]).mean() > 0.4:
        return False
    center = np.median(graph.points[support.vertices, :2], axis=0)
    low, high = graph.points[part, :2].min(axis=0), graph.points[part, :2].max(axis=0)
    if ((center > low) & (center < high)).all():
        return False  # it surrounds the flat top
    plan = np.prod(np.ptp(graph.points[rest, :2], axis=0))
    if support.footprint.area_m2 < 0.4 * plan:
        return False  # the flat region is not the top of the other thing
    # It must reach the ground that the other thing stands on: otherwise it is a lid or a handle.
    if graph.points[part, 2].min() > graph.points[rest, 2].min() + 0.03:
        return False
    weight = [0.5, 1, 1]
    top_color = np.median(graph.lab[support.vertices], axis=0) * weight
    return float(np.linalg.norm(np.median(graph.lab[candidate], axis=0) * weight - top_color)) > 9.0
