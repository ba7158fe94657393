"""Rooms' graphs of clusters with truth: what the second network of the learned cut is trained and measured on."""

from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path

from priors.partition_rooms import Example, room_view
from priors.samples import Room
from reconstruction.instances.partition.clusters import cluster_graph
from reconstruction.instances.partition.features import Shapes
from reconstruction.instances.partition.graph import region_graph
from reconstruction.instances.partition.model import Ensemble
from reconstruction.instances.partition.multicut import partition_with_labels

Job = tuple[Room, Example, Ensemble, Path]


def cluster_examples(
    rooms: Sequence[Room],
    superpoints: Sequence[Example],
    models: Sequence[Ensemble],
    cache: Path,
    processes: int,
) -> list[Example]:
    """Return the graph of clusters of each room.

    Args:
        rooms: arrays on disk.
        superpoints: their graphs of superpoints.
        models: for each room what partitions it; networks that were trained on a room make other clusters there than
            elsewhere, so that it is one that was not.
        cache: folder with the fused surfaces.
        processes: at work at once.
    """
    jobs = [(*job, cache) for job in zip(rooms, superpoints, models, strict=True)]
    if processes == 1:
        return [_made(job) for job in jobs]
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn"), initializer=_alone) as pool:
        return list(pool.map(_made, jobs))


def _alone() -> None:
    import cv2
    import numba
    import torch

    numba.set_num_threads(1)
    cv2.setNumThreads(1)
    torch.set_num_threads(1)


def _made(job: Job) -> Example:
    room, example, model, cache = job
    view = room_view(room, cache)
    scores = model.scores(example.nodes, example.edges, example.pairs)
    label, cluster = partition_with_labels(example.pairs, scores.affinity, scores.label)
    pieces = cluster_graph(view, region_graph(view.mesh), scores, label, cluster)
    centers = Shapes.of(view.mesh, pieces.graph).center
    return replace(
        example, nodes=pieces.nodes, edges=pieces.edges, pairs=pieces.graph.pairs, region=pieces.graph.region,
        centers=centers.astype(example.centers.dtype),
    )  # fmt: skip
