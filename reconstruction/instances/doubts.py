"""Things without the surface that the keyframes speak against, and without the islands that only hung by it."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from reconstruction.instances.cut import Shell
from reconstruction.instances.segmentation import Thing
from reconstruction.instances.sightings import Sighting, unconfirmed
from reconstruction.progress import Progress
from reconstruction.surface.mesh_graph import MeshGraph, pieces

_LEAST_LEFT = 0.5  # of a thing's area: what was seen too badly to be confirmed is better than nothing
_BRIDGE_M = 0.03
_ISLAND_SHARE = 0.2  # of the largest piece that is left
_LARGEST_M = 0.6  # furniture is seen in pieces: boards, legs


@dataclass(frozen=True)
class Taken:
    """What was taken from one thing."""

    kept: np.ndarray  # int (n,) vertices that are left of it
    gone: np.ndarray  # int (m,) vertices that are not


def without_doubts(
    shell: Shell, things: list[Thing], frames: list[Sighting], progress: Progress
) -> list[Taken]:
    """Take from things, in place, what is smeared between them and what is behind them.

    Args:
        shell: the surface.
        things: what was found. Flat ones on walls stay as they are: their color tells of them, not their depth.
        frames: keyframes, the surface drawn into them.
        progress: told of how many things had such surface.

    Returns:
        What was taken, and from what.
    """
    graph = shell.graph
    taken: list[Taken] = []
    doubtful = unconfirmed(graph.points, graph.normals, frames)
    for thing in things:
        if thing.attached:
            continue
        kept = _confirmed_part(graph, thing.vertices, doubtful)
        if len(kept) < len(thing.vertices):
            taken.append(Taken(kept, np.setdiff1d(thing.vertices, kept, assume_unique=True)))
        thing.vertices = kept
    if taken:
        progress.note(f"{len(taken)} things are freed of surface that no keyframe, or few of them, confirm")
    return taken


def as_drawn(graph: MeshGraph, vertex_instance: np.ndarray, taken: list[Taken]) -> np.ndarray:
    """Return the ids (v,) for drawing, in which things, or the parts they were cut into, have again what was taken.

    What is smeared hangs at outlines, where the edges of the image decide; of a thing that is small in the image the
    rim, seen at a slant, is half of it.
    """
    out = vertex_instance.copy()
    for part in taken:
        nearest = cKDTree(graph.points[part.kept]).query(graph.points[part.gone])[1]
        out[part.gone] = vertex_instance[part.kept[nearest]]
    return out


def _confirmed_part(graph: MeshGraph, vertices: np.ndarray, doubtful: np.ndarray) -> np.ndarray:
    """Return what is confirmed of a thing's vertices, or all of them where too little is."""
    kept = vertices[~doubtful[vertices]]
    if graph.areas[kept].sum() < _LEAST_LEFT * graph.areas[vertices].sum():
        return vertices
    if np.ptp(graph.points[vertices], axis=0).max() > _LARGEST_M:
        return kept
    parts = pieces(graph, kept, _BRIDGE_M)
    least = _ISLAND_SHARE * graph.areas[parts[0]].sum()
    return np.sort(np.concatenate([part for part in parts if graph.areas[part].sum() >= least]))
