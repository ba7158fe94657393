"""Surface that is no thing: scraps in mid-air, crumbs, and what shows in no keyframe."""

from dataclasses import replace

import cv2
import numpy as np
from scipy.spatial import cKDTree

from reconstruction.instances.boxes import quantiles
from reconstruction.instances.config import InstancesConfig
from reconstruction.instances.convexity import bulge
from reconstruction.instances.outlines import inset
from reconstruction.instances.segmentation import Thing
from reconstruction.progress import Progress
from reconstruction.surface.mesh_graph import MeshGraph
from reconstruction.types import InstanceSet

SKIRT_M, _SKIRT_BULGE = 0.08, 0.45  # at most: height, shape
_SKIRT_TOP = 0.4  # at most: share of the outline that is a top
_UP, _TOP_M = 0.6, 0.012
_COLLAR_M = 0.02  # how far a skirt rises around the foot of what seems to lie on it: plates rise less
TOUCH_M, _BESIDE_M = 0.015, 0.06  # from a larger thing: its nearest, and four fifths of it


def without_fragments(
    graph: MeshGraph, things: list[Thing], floor_seen: bool, config: InstancesConfig, progress: Progress
) -> list[Thing]:
    """Leave out scraps of surface that are no things: tiny ones, and small ones in mid-air or flat on a wall."""
    carriers = {id(thing.rests_on) for thing in things}
    kept = []
    for thing in things:
        points = graph.points[thing.vertices]
        extents = np.sort(np.ptp(points, axis=0))
        in_air = floor_seen and not thing.attached and thing.rests_on is None and points[:, 2].min() > 0.1
        tiny = graph.areas[thing.vertices].sum() < config.min_object_area_m2
        scrap = (in_air and extents[2] < config.min_floating_m) or (
            thing.attached and extents[1] < config.min_picture_m
        )
        if id(thing) in carriers or not (tiny or scrap):
            kept.append(thing)
    if len(kept) < len(things):
        progress.note(
            f"{len(things) - len(kept)} scraps of surface, tiny or in mid-air, are not kept as things"
        )
    return kept


def without_skirts(graph: MeshGraph, things: list[Thing], progress: Progress) -> list[Thing]:
    """Leave out what depth smeared behind and beside things: low sheets without a top, close to something larger."""
    kept = [
        thing
        for thing in things
        if thing.attached
        or thing.container
        or thing.foreign
        or thing.rests_on is None
        or not _is_skirt(graph, thing, things)
    ]
    left = {id(thing) for thing in kept}
    for thing in kept:  # what was thought to lie on a skirt rests on what that lies on
        while thing.rests_on is not None and id(thing.rests_on) not in left:
            thing.rests_on = thing.rests_on.rests_on
    if len(kept) < len(things):
        progress.note(f"{len(things) - len(kept)} skirts of smeared surface beside things are not kept")
    return kept


def _is_skirt(graph: MeshGraph, thing: Thing, things: list[Thing]) -> bool:
    points, areas = graph.points[thing.vertices], graph.areas[thing.vertices]
    if not is_low(graph, thing, _SKIRT_TOP):
        return False
    if thing.sheet:
        return True
    low, middle, high = quantiles(points[:, 2], areas, (0.02, 0.5, 0.98))
    beyond = np.full(len(points), np.inf)  # of all larger ones that it touches
    for other in things:
        if other is thing or other.attached:
            continue
        if other.rests_on is thing and not _stands_in(graph, other, low, high):
            continue  # what lies on a plate hides its top
        if graph.areas[other.vertices].sum() < areas.sum():
            continue
        reach = quantiles(graph.points[other.vertices, 2], graph.areas[other.vertices], (0.98,))[0]
        if (middle > reach - _TOP_M) if other is thing.rests_on else (high > reach + _TOP_M):
            continue  # on it, or higher than it
        gap = cKDTree(graph.points[other.vertices]).query(points, distance_upper_bound=TOUCH_M)[0]
        if not np.isfinite(gap).any():
            continue
        outline = cv2.convexHull(graph.points[other.vertices, :2].astype(np.float32))
        beyond = np.minimum(beyond, -inset(outline, points[:, :2]))
    return bool(np.isfinite(beyond[0]) and quantiles(beyond, areas, (0.8,))[0] < _BESIDE_M)


def is_low(graph: MeshGraph, thing: Thing, most_top: float) -> bool:
    """Tell whether a thing is low and hardly bulges, and a top covers at most such a share of its outline."""
    points, areas = graph.points[thing.vertices], graph.areas[thing.vertices]
    low, high = quantiles(points[:, 2], areas, (0.02, 0.98))
    if high - low > SKIRT_M or bulge(graph, thing.vertices) > _SKIRT_BULGE:
        return False
    hull = cv2.convexHull(points[:, :2].astype(np.float32))
    top = (graph.normals[thing.vertices, 2] > _UP) & (points[:, 2] > high - _TOP_M)
    return bool(areas[top].sum() <= most_top * cv2.contourArea(hull))


def _stands_in(graph: MeshGraph, other: Thing, low: float, high: float) -> bool:
    """Tell whether a thing begins in the lower half of what rises between two heights, and far below its end."""
    bottom = quantiles(graph.points[other.vertices, 2], graph.areas[other.vertices], (0.02,))[0]
    return bool(bottom < 0.5 * (low + high) and high - bottom > _COLLAR_M)


def without_unseen(found: InstanceSet, config: InstancesConfig, progress: Progress) -> InstanceSet:
    """Leave out what shows in no keyframe once depth and image edges had their say: surface without a thing."""
    count = max((o.id for o in found.objects), default=0) + 1
    best = np.zeros(count, np.int64)
    for id_map in found.id_maps:
        seen = np.bincount(id_map.ravel(), minlength=count)[:count]
        best = np.maximum(best, seen)
    fewest = config.min_object_image_share * found.id_maps[0].size
    gone = {o.id: o.support_hint for o in found.objects if best[o.id] < fewest}
    if not gone:
        return found
    progress.note(f"{len(gone)} scraps that show in no keyframe are not kept as things")

    def carrier(hint: int) -> int:
        while hint in gone:
            hint = gone[hint]
        return hint

    erased = np.array(sorted(gone))
    return InstanceSet(
        np.where(np.isin(found.vertex_instance, erased), 0, found.vertex_instance).astype(np.int32),
        found.base,
        tuple(replace(o, support_hint=carrier(o.support_hint)) for o in found.objects if o.id not in gone),
        np.where(np.isin(found.id_maps, erased), 0, found.id_maps).astype(np.uint16),
    )
