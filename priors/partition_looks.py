"""Rooms' graphs for the second look: regions that the first one surely merges are one, and their features are new."""

import hashlib
from dataclasses import replace
from pathlib import Path

import numpy as np

from priors.partition_rooms import Example, cached, read_example, room_view, write_example
from priors.samples import Room
from reconstruction.instances.partition.cut import features, sure_unions
from reconstruction.instances.partition.features import Shapes
from reconstruction.instances.partition.graph import region_graph
from reconstruction.instances.partition.model import Model


def next_look(room: Room, first: Example, model: Model, cache: Path) -> Example:
    """Return the room's graph after the sure unions of a first look, from the cache if it was made with this model.

    Args:
        room: arrays on disk.
        first: its graph of superpoints.
        model: of the first look.
        cache: folder with its fused surface.
    """
    digest = hashlib.sha256(first.nodes.tobytes() + first.edges.tobytes())
    for name in sorted(model.weights):
        digest.update(name.encode() + model.weights[name].tobytes())
    file = cached(room, cache, f"looks-{digest.hexdigest()[:12]}").with_suffix(".npz")
    if not file.is_file():
        write_example(file, _made(room, first, model, cache))
    return read_example(file)


def _made(room: Room, first: Example, model: Model, cache: Path) -> Example:
    view = room_view(room, cache)
    graph = region_graph(view.mesh)
    graph = graph.merged(sure_unions(graph, model.scores(first.nodes, first.edges, first.pairs)))
    nodes, edges = features(view, graph)
    centers = Shapes.of(view.mesh, graph).center.astype(np.float32)
    return replace(first, nodes=nodes, edges=edges, pairs=graph.pairs, centers=centers, region=graph.region)
