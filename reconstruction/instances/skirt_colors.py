"""Low things that no skirt can be: they show what nothing around them shows.

A skirt is surface that depth smeared between a thing and what is below or behind it, and the frames show one of these
on it: what carries the thing, the larger one that it touches, or the room behind. A wedge or a sponge is as low and as
slanted, but most frames that see it see a color that none of them has.
"""

import numpy as np
from scipy.spatial import cKDTree

from reconstruction.instances.foreign import ColorView, main_colors
from reconstruction.instances.scraps import SKIRT_M, TOUCH_M, is_low
from reconstruction.instances.segmentation import Thing
from reconstruction.surface.mesh_graph import MeshGraph

_MOST_SAMPLES = 4000  # vertices that tell the colors of the floor or a wall
_MOST = 0.6  # share of a thing that is of another color
_SHEET_TOP, _SHEET_OTHER = 0.15, 0.3  # of a sheet: share of its outline that is a top, and of another color
_FURNITURE_M = 0.45


def mark_unlike(view: ColorView, things: list[Thing], owner: np.ndarray) -> None:
    """Mark low things as foreign whose colors neither what they touch nor the room has.

    Args:
        view: the surface and the keyframes.
        things: what was found; `foreign` is set.
        owner: int32 (v,) base entity of each vertex, 0 for none.
    """
    graph = view.graph
    low = [
        thing
        for thing in things
        if not (thing.attached or thing.container or thing.foreign or thing.rests_on is None)
        and np.ptp(graph.points[thing.vertices, 2]) < 2.0 * SKIRT_M
    ]
    if not low:
        return
    room = []
    for number in np.unique(owner[owner > 0]):
        vertices = np.flatnonzero(owner == number)
        room.append(main_colors(graph, vertices[:: max(1, len(vertices) // _MOST_SAMPLES)]))
    for thing in low:
        around = [main_colors(graph, other.vertices) for other in _around(graph, thing, things)]
        other = view.foreign(thing.vertices, np.concatenate([*room, *around]))
        areas = graph.areas[thing.vertices]
        thing.foreign = bool(areas[other].sum() > _MOST * areas.sum())
        if not thing.foreign and is_low(graph, thing, _SHEET_TOP):
            odd = view.foreign(thing.vertices, main_colors(graph, _furniture(graph, thing).vertices))
            thing.sheet = bool(areas[odd].sum() < _SHEET_OTHER * areas.sum())


def _furniture(graph: MeshGraph, thing: Thing) -> Thing:
    """Return what carries a thing, and what carries that, up to furniture: sheets seem to lie on one another."""
    carrier = thing.rests_on
    while (
        carrier.rests_on is not None and np.ptp(graph.points[carrier.vertices], axis=0).max() < _FURNITURE_M
    ):
        carrier = carrier.rests_on
    return carrier


def _around(graph: MeshGraph, thing: Thing, things: list[Thing]) -> list[Thing]:
    """Return what carries a thing and what larger ones it touches."""
    area, tree = graph.areas[thing.vertices].sum(), cKDTree(graph.points[thing.vertices])
    out = []
    for other in things:
        if other is thing or other.rests_on is thing:
            continue
        if other is thing.rests_on:
            out.append(other)
        elif graph.areas[other.vertices].sum() >= area:
            gap = tree.query(graph.points[other.vertices], distance_upper_bound=TOUCH_M)[0]
            if np.isfinite(gap).any():
                out.append(other)
    return out
