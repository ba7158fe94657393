"""The bottom and the inner sides of a container belong to it, though creases and colors part them.

What was put into a container has a shape of its own: its normals turn outwards around it. A piece of surface that lies
within the outline of another thing, hardly lower and no higher than that, and does not bulge, is its inside.
"""

import numpy as np
from scipy.spatial import cKDTree

from reconstruction.instances.convexity import MIN_BULGE, bulge, is_within
from reconstruction.instances.merging import join
from reconstruction.instances.segmentation import Thing
from reconstruction.progress import Progress
from reconstruction.surface.mesh_graph import MeshGraph

_SLACK_M = 0.01
_UNSEEN_FOOT_M = (
    0.03  # outer sides are seen down to here above the bottom: skirts and shadows hide their foot
)
_TOUCH_M = 0.02


def merge_insides(graph: MeshGraph, things: list[Thing], progress: Progress) -> list[Thing]:
    """Join insides with their containers, small ones first; what lay on an inside then lies in the container."""
    things = list(things)
    merged = 0
    for inner in sorted(things, key=lambda t: (float(graph.areas[t.vertices].sum()), int(t.vertices[0]))):
        if inner.attached or bulge(graph, inner.vertices) >= MIN_BULGE:
            continue
        container = next((t for t in things if t is not inner and _holds(graph, t, inner)), None)
        if container is None:
            continue
        things = join(things, inner, container)
        merged += 1
    if merged:
        progress.note(f"{merged} bottoms and inner sides are joined with the containers around them")
    return things


def _holds(graph: MeshGraph, container: Thing, inner: Thing) -> bool:
    """Only between things of one place: one on the other, or both on the same."""
    if container.attached or not (
        inner.rests_on is container or container.rests_on is inner or container.rests_on is inner.rests_on
    ):
        return False
    if graph.areas[container.vertices].sum() < graph.areas[inner.vertices].sum():
        return False
    low, high = np.percentile(graph.points[container.vertices, 2], [1, 99])
    bottom, top = np.percentile(graph.points[inner.vertices, 2], [1, 99])
    if bottom < low - _UNSEEN_FOOT_M or top > high + _SLACK_M:
        return False
    if bottom > 0.5 * (low + high) + _SLACK_M:
        return False  # what lies on top, not at the bottom
    gap, _ = cKDTree(graph.points[container.vertices]).query(graph.points[inner.vertices])
    return bool(gap.min() < _TOUCH_M) and is_within(graph, inner.vertices, container.vertices)
