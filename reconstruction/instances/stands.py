"""Furniture that was cut at its own top: what carries a wide top from below within its outline belongs to it.

Legs and trestles end at the level of the top that they carry, so cutting there parts a table in two where its sides
were not seen well. Two signs tell that from a thing put onto another:

- the upper one reaches down beside the lower one, which nothing does that stands on it;
- the upper one is a wide slab that hides all of the lower one from above: a board on legs.
"""

import cv2
import numpy as np

from reconstruction.instances.boxes import quantiles
from reconstruction.instances.merging import merge_pairs
from reconstruction.instances.outlines import inset
from reconstruction.instances.segmentation import Thing
from reconstruction.progress import Progress
from reconstruction.surface.mesh_graph import MeshGraph

_MIN_AREA_M2 = 0.15  # of a piece of furniture from above
_REACHES_DOWN = 0.5  # share of the lower one's height that the upper one covers, too
_SLAB_M, _SLAB_SHARE = 0.12, 0.35  # thickness of a board, in metres and as a share of what is below
_REACH_M = 0.03
_MIN_HEIGHT_M = 0.15  # of a stand: lower things below a top are things
_MIN_INSIDE = 0.85


def merge_stands(graph: MeshGraph, things: list[Thing], progress: Progress) -> list[Thing]:
    """Join tops with their stands; what rested on the top then rests on the whole."""
    things, merged = merge_pairs(things, lambda top, among: _stand_of(graph, top, among))
    if merged:
        progress.note(f"{merged} tops are joined with the stands below them")
    return things


def _stand_of(graph: MeshGraph, top: Thing, things: list[Thing]) -> Thing | None:
    """Return what carries a furniture top from below within its outline, or None."""
    if top.attached:
        return None
    outline = _outline(graph, top)
    if cv2.contourArea(outline) < _MIN_AREA_M2:
        return None
    low, high = _heights(graph, top, 0.005)  # one leg is a small part of a table
    for stand in things:
        if stand is top or stand.attached:
            continue
        stand_low, stand_high = _heights(graph, stand, 0.02)
        height = max(stand_high - stand_low, 1e-3)
        if height < _MIN_HEIGHT_M or stand_high > high or stand_low > low + _REACH_M:
            continue
        reaches_down = stand_high - low > _REACHES_DOWN * height
        slab = high - low < min(_SLAB_M, _SLAB_SHARE * height) and low - stand_high < _REACH_M
        if not (reaches_down or slab):
            continue
        # Its upper half counts: feet may be spread, and scraps of the floor cling to them.
        upper = stand.vertices[graph.points[stand.vertices, 2] > 0.5 * (stand_low + stand_high)]
        if len(upper) and _share_within(graph, upper, outline) > _MIN_INSIDE:
            return stand
    return None


def _heights(graph: MeshGraph, thing: Thing, low: float) -> np.ndarray:
    """Return the height above which all but `low` of a thing's area is, and that below which 98 % of it is."""
    return quantiles(graph.points[thing.vertices, 2], graph.areas[thing.vertices], (low, 0.98))


def _share_within(graph: MeshGraph, vertices: np.ndarray, outline: np.ndarray) -> float:
    """Return the share of the vertices' area within an outline from above, grown by the reach."""
    inside = inset(outline, graph.points[vertices, :2]) > -_REACH_M
    return float(np.average(inside, weights=np.maximum(graph.areas[vertices], 1e-12)))


def _outline(graph: MeshGraph, thing: Thing) -> np.ndarray:
    """Return the convex outline from above, float32 (k, 1, 2)."""
    return cv2.convexHull(graph.points[thing.vertices, :2].astype(np.float32))
