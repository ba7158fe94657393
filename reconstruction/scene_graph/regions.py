"""Cut the room into regions: DBSCAN on object centers, strays join the nearest (the paper, section 3.3)."""

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from reconstruction.core.types import ObjectAsset


def dbscan(points: np.ndarray, radius: float, min_points: int) -> np.ndarray:
    """Cluster points (n, d); return labels (n,) from 0 on, -1 for noise.

    Border points go to the cluster of their nearest core point, so that labels do not depend on the order of
    points except for their numbering.
    """
    n = len(points)
    labels = np.full(n, -1)
    if n == 0:
        return labels
    neighbors = cKDTree(points).query_ball_point(points, radius)
    core = np.array([len(found) >= min_points for found in neighbors])
    count = 0
    for seed in range(n):
        if not core[seed] or labels[seed] >= 0:
            continue
        stack = [seed]
        labels[seed] = count
        while stack:
            for other in neighbors[stack.pop()]:
                if core[other] and labels[other] < 0:
                    labels[other] = count
                    stack.append(other)
        count += 1
    for i in np.flatnonzero(~core):
        reachable = [j for j in neighbors[i] if core[j]]
        if reachable:
            labels[i] = labels[min(reachable, key=lambda j: (np.linalg.norm(points[j] - points[i]), j))]
    return labels


def find_regions(
    objects: Sequence[ObjectAsset], radius_m: float, min_points: int, view_margin_m: float
) -> list[tuple[tuple[int, ...], tuple[int, ...]]]:
    """Return (members, visible) ids per region: visible is what a view of the members shows.

    Regions partition the objects; views overlap, which is what lets the merge find and settle disagreements.
    The result does not depend on the order of `objects`.
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
        regions.append(
            (
                tuple(o.id for o, keep in zip(objects, inside) if keep),
                tuple(o.id for o, keep in zip(objects, seen) if keep),
            )
        )
    return regions


def world_box(asset: ObjectAsset) -> np.ndarray:
    """Return the axis-aligned world box (2, 3) of an object's visual mesh."""
    m = asset.world_from_object
    points = np.asarray(asset.visual.vertices, np.float64) @ m[:3, :3].T + m[:3, 3]
    return np.stack([points.min(axis=0), points.max(axis=0)])
