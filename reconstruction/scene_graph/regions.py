"""Cluster objects into regions by DBSCAN on their centers; noise joins the nearest region (the paper, section 3.3)."""

from collections.abc import Sequence

import numpy as np
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]

from reconstruction.core.types import ObjectAsset
from registry.geometry import transform_points


def dbscan(points: np.ndarray, radius: float, min_points: int) -> np.ndarray:
    """Cluster points (n, d) by DBSCAN; return labels int (n,) from 0, -1 for noise.

    Border points join the cluster of their nearest core point, so that the order of points affects only the numbering.
    """
    n = len(points)
    labels = np.full(n, -1)
    if n == 0:
        return labels
    neighbors = cKDTree(points).query_ball_point(points, radius)
    core = np.array([len(found) >= min_points for found in neighbors])
    cores = np.flatnonzero(core)
    if len(cores):
        links = cKDTree(points[cores]).sparse_distance_matrix(
            cKDTree(points[cores]), radius, output_type="coo_matrix"
        )
        labels[cores] = connected_components(links, directed=False)[1]
    for i in np.flatnonzero(~core):
        reachable = [j for j in neighbors[i] if core[j]]
        if reachable:
            labels[i] = labels[min(reachable, key=lambda j: (np.linalg.norm(points[j] - points[i]), j))]
    return labels


def find_regions(
    objects: Sequence[ObjectAsset], radius_m: float, min_points: int, view_margin_m: float
) -> list[tuple[tuple[int, ...], tuple[int, ...]]]:
    """Return the ids (members, visible) of each region; `visible` are all objects near the members' box.

    Members partition the objects; visible ones overlap, so that merging can detect and resolve conflicts. The result
    does not depend on the order of `objects`.
    """
    objects = sorted(objects, key=lambda o: o.id)
    if not objects:
        return []
    boxes = np.array([world_box(o) for o in objects])
    centers = boxes.mean(axis=1)
    labels = dbscan(centers, radius_m, min_points)
    if (labels < 0).all():
        labels[:] = 0
    clustered = np.flatnonzero(labels >= 0)
    for i in np.flatnonzero(labels < 0):
        labels[i] = labels[clustered[np.argmin(np.linalg.norm(centers[clustered] - centers[i], axis=1))]]
    regions = []
    for label in range(labels.max() + 1):
        inside = labels == label
        low = boxes[inside, 0].min(axis=0) - view_margin_m
        high = boxes[inside, 1].max(axis=0) + view_margin_m
        seen = inside | np.all((boxes[:, 1] > low) & (boxes[:, 0] < high), axis=1)
        members, visible = (tuple(objects[i].id for i in np.flatnonzero(mask)) for mask in (inside, seen))
        regions.append((members, visible))
    return regions


def world_box(asset: ObjectAsset) -> np.ndarray:
    """Return the axis-aligned world box (2, 3), low and high, of an object's visual mesh."""
    points = transform_points(asset.world_from_object, np.asarray(asset.visual.vertices, np.float64))
    return np.stack([points.min(axis=0), points.max(axis=0)])
