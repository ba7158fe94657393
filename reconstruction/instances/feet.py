"""A thin slice below a single thing, no wider than it, is that thing's foot and not another thing.

Cutting things at the level of their support sometimes leaves the flare of a pot's bottom or a bowl's ring behind. What
really carries a thing alone (a plate, a book, a coaster) reaches beyond it.
"""

import cv2
import numpy as np

from reconstruction.instances.merging import merge_pairs
from reconstruction.instances.outlines import inset
from reconstruction.instances.segmentation import Thing
from reconstruction.progress import Progress
from reconstruction.surface.mesh_graph import MeshGraph

_MAX_HEIGHT_M = 0.04
_MAX_HEIGHT_SHARE = 0.5  # of the thing above
_MAX_AREA_SHARE = 0.5
_REACH_M = 0.01
_MIN_INSIDE = 0.6


def merge_feet(graph: MeshGraph, things: list[Thing], progress: Progress) -> list[Thing]:
    """Join feet with what stands on them, from the top of each pile down."""
    things, merged = merge_pairs(things, lambda thing, among: _foot_of(graph, thing, among))
    if merged:
        progress.note(f"{merged} thin slices below things are taken for their feet")
    return things


def _foot_of(graph: MeshGraph, thing: Thing, things: list[Thing]) -> Thing | None:
    """Return the thing that `thing` is the foot of, or None."""
    if thing.attached:
        return None
    carried = [other for other in things if other.rests_on is thing]
    if len(carried) != 1:
        return None
    low, high = np.percentile(graph.points[thing.vertices, 2], [1, 99])
    above_low, above_high = np.percentile(graph.points[carried[0].vertices, 2], [1, 99])
    if high - low > min(_MAX_HEIGHT_M, _MAX_HEIGHT_SHARE * (above_high - above_low)):
        return None
    own, other = _outline(graph, thing), _outline(graph, carried[0])
    if cv2.contourArea(own) > _MAX_AREA_SHARE * cv2.contourArea(other):
        return None
    inside = inset(other, graph.points[thing.vertices, :2]) > -_REACH_M
    return carried[0] if np.mean(inside) > _MIN_INSIDE else None


def _outline(graph: MeshGraph, thing: Thing) -> np.ndarray:
    """Return the convex footprint, float32 (k, 1, 2), without the outermost stray vertices."""
    flat = graph.points[thing.vertices, :2]
    middle = np.median(flat, axis=0)
    far = np.linalg.norm(flat - middle, axis=1)
    return cv2.convexHull(flat[far <= np.percentile(far, 98)].astype(np.float32))
