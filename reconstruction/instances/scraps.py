"""Surface that is no thing: scraps in mid-air, crumbs, and what shows in no keyframe."""

from dataclasses import replace

import numpy as np

from reconstruction.instances.config import InstancesConfig
from reconstruction.instances.segmentation import Thing
from reconstruction.progress import Progress
from reconstruction.surface.mesh_graph import MeshGraph
from reconstruction.types import InstanceSet


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
