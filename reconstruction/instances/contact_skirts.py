"""Stacks that only show once what was smeared over them is gone, and the skirts around the feet of things.

A step of outline and color low above the foot of a thing that hardly reaches beyond what is above it is no plate: it
is the skirt of its support's surface that depth drags up around the contact. And what is narrower than what it is on
and not half as high, or as slim as a corner of it, is a cap or a sliver, unless it showed at first sight.
"""

import numpy as np

from reconstruction.instances.boxes import quantiles
from reconstruction.instances.config import InstancesConfig
from reconstruction.instances.merging import join
from reconstruction.instances.segmentation import Thing
from reconstruction.instances.stacks import cut_stacks
from reconstruction.progress import Progress
from reconstruction.surface.mesh_graph import MeshGraph
from reconstruction.types import DepthMaps, PosedFrames, Surface

_LOW_M = 0.02
_BEYOND_M = 0.04  # in both directions together: what reaches less far on each side than half of it is a skirt
_CAP_HEIGHT, _CAP_AREA, _SLIM_AREA = 0.5, 0.9, 0.2  # of what it is on; areas in plan


def cut_cleaned_stacks(
    graph: MeshGraph,
    surface: Surface,
    things: list[Thing],
    posed: PosedFrames,
    depth: DepthMaps,
    config: InstancesConfig,
    progress: Progress,
) -> list[Thing]:
    """Cut stacks among things that were cleaned; caps stay, and parts that turn out to be skirts are dropped.

    Args, and what is returned, are those of `cut_stacks`.
    """
    out = cut_stacks(graph, surface, things, posed, depth, config, progress, flats=False)
    for upper in out[len(things) :]:
        lower = upper.rests_on
        if lower is None:
            continue
        if _is_cap(graph, lower, upper):
            out = join(out, upper, lower)
        elif _is_skirt(graph, lower, upper):
            upper.rests_on, upper.depth = lower.rests_on, lower.depth
            out = [thing for thing in out if thing is not lower]
            for thing in out:
                if thing.rests_on is lower:
                    thing.rests_on = upper
    return out


def _is_cap(graph: MeshGraph, lower: Thing, upper: Thing) -> bool:
    wide, deep, height = _spans(graph, lower)
    upper_wide, upper_deep, upper_height = _spans(graph, upper)
    share = upper_wide * upper_deep / max(wide * deep, 1e-9)
    return bool(share < _SLIM_AREA or (share < _CAP_AREA and upper_height < _CAP_HEIGHT * height))


def _is_skirt(graph: MeshGraph, lower: Thing, upper: Thing) -> bool:
    wide, deep, height = _spans(graph, lower)
    upper_wide, upper_deep, _ = _spans(graph, upper)
    return bool(height < _LOW_M and max(wide - upper_wide, deep - upper_deep) < _BEYOND_M)


def _spans(graph: MeshGraph, thing: Thing) -> list[float]:
    """Return how far a thing reaches along x, y and z."""
    points, areas = graph.points[thing.vertices], graph.areas[thing.vertices]
    return [float(np.ptp(quantiles(points[:, k], areas, (0.02, 0.98)))) for k in range(3)]
