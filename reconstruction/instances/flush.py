"""Cuts that run through one smooth top of one color are undone: they part no things.

Where a thing touches several others, cuts along those contacts may go on across the thing itself. What lies on either
side of such a cut is level with the other, slants as it does, and has its color; two things that touch have a crease
or a step between them, or colors of their own.
"""

import numpy as np

from reconstruction.instances.merging import merge_pairs
from reconstruction.instances.patches import contacts_of
from reconstruction.instances.segmentation import Thing
from reconstruction.instances.supports import median_color
from reconstruction.progress import Progress
from reconstruction.surface.mesh_graph import MeshGraph

_LEAST_BORDER_M = 0.05  # of common border
_SMOOTH_DEG = 8.0  # mean angle across it: noise of normals, no crease
_LEVEL = 0.5  # share of the border beside which both are tops
_ALIKE = 5.0  # CIELAB, lightness at half weight


def merge_flush(graph: MeshGraph, things: list[Thing], progress: Progress) -> list[Thing]:
    """Join things on the same support whose tops go on into each other in one color."""

    def partner_of(thing: Thing, among: list[Thing]) -> Thing | None:
        area = graph.areas[thing.vertices].sum()
        larger = [t for t in among if t is not thing and graph.areas[t.vertices].sum() >= area]
        return next((other for other in larger if _goes_on(graph, thing, other)), None)

    things, merged = merge_pairs(things, partner_of)
    if merged:
        progress.note(f"{merged} parts of tops that were cut apart are joined again")
    return things


def _goes_on(graph: MeshGraph, thing: Thing, other: Thing) -> bool:
    if thing.attached or other.attached or thing.container or other.container:
        return False
    if thing.rests_on is None or thing.rests_on is not other.rests_on:
        return False
    if np.linalg.norm(median_color(graph, thing.vertices) - median_color(graph, other.vertices)) > _ALIKE:
        return False
    body = np.union1d(thing.vertices, other.vertices)
    row = np.full(len(graph.points), -1, np.int64)
    row[body] = np.arange(len(body))
    side = np.isin(body, other.vertices).astype(np.int64)
    found = contacts_of(graph, body, row[graph.edges_within(body)], side)
    if len(found.pairs) == 0 or found.length_m[0] < _LEAST_BORDER_M:
        return False
    return bool(abs(found.bend_deg[0]) < _SMOOTH_DEG and found.level[0].min() > _LEVEL)
