"""Join things that turn out to be one."""

from collections.abc import Callable

import numpy as np
from scipy.spatial import cKDTree

from reconstruction.instances.segmentation import Thing
from reconstruction.surface.mesh_graph import MeshGraph


def merge_pairs(
    things: list[Thing], partner_of: Callable[[Thing, list[Thing]], Thing | None]
) -> tuple[list[Thing], int]:
    """Merge each thing into its partner, if it has one, until none has.

    What rested on the merged thing then rests on the partner, and the partner on what the merged thing rested on, if it
    rested on that one.

    Returns:
        The things that are left, and how many were merged away.
    """
    things, merged = list(things), 0
    while True:
        pair = next(((gone, kept) for gone in things if (kept := partner_of(gone, things)) is not None), None)
        if pair is None:
            return things, merged
        gone, kept = pair
        things = join(things, gone, kept)
        merged += 1


def join(things: list[Thing], gone: Thing, kept: Thing) -> list[Thing]:
    """Merge one thing into another and return those that are left; what rested on it rests on the other then."""
    kept.vertices = np.union1d(kept.vertices, gone.vertices)
    if kept.rests_on is gone:
        kept.rests_on = gone.rests_on
    things = [thing for thing in things if thing is not gone]
    for other in things:
        if other.rests_on is gone:
            other.rests_on = kept
    return things


def nearest_of(graph: MeshGraph, thing: Thing, parts: tuple[Thing, Thing]) -> Thing:
    """Return the part of what a thing rested on that its foot is nearest to, the first of equals."""
    points = graph.points[thing.vertices]
    foot = points[points[:, 2] < points[:, 2].min() + 0.02]
    return min(parts, key=lambda part: float(np.median(cKDTree(graph.points[part.vertices]).query(foot)[0])))
