"""Rooms' clusters and proposals with truth: what the boosted trees of the learned cut are fitted to and measured on."""

from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from itertools import pairwise
from multiprocessing import get_context
from pathlib import Path
from typing import TypeVar

import numpy as np
from scipy.sparse import csr_matrix

from priors.partition_rooms import TRIMMED, Example, cached, digest_of, example, room_view, write_arrays
from priors.rooms import Sources
from priors.samples import Room
from reconstruction.instances.partition.base_parts import with_parts_of_base
from reconstruction.instances.partition.boosting import Boosted
from reconstruction.instances.partition.clusters import ClusterGraph, cluster_graph
from reconstruction.instances.partition.features import View
from reconstruction.instances.partition.graph import Scores, region_graph
from reconstruction.instances.partition.model import Ensemble, load_models
from reconstruction.instances.partition.multicut import partition_with_labels
from reconstruction.instances.partition.proposal_features import proposal_features
from reconstruction.instances.partition.proposals import Proposals, propose
from reconstruction.measure.matching import box_iou

_PURE = 0.6  # of a cluster's known surface must be of one entity
_CRUMB_M2 = 1e-4  # clusters below this count less
_TINY = 1e-12
T = TypeVar("T")
J = TypeVar("J")


@dataclass(frozen=True)
class Clusters:
    """One room's clusters."""

    room: Room
    example: Example
    scores: Scores  # of superpoints
    label: np.ndarray  # int (s,) of superpoints
    pieces: ClusterGraph

    def table(self) -> np.ndarray:
        """Return the surface of each entity in each cluster of things, float (n, ids), m2."""
        region, count = self.pieces.graph.region, self.pieces.things
        out = np.zeros((count + 1, len(self.example.pixels)))
        np.add.at(out, (region, self.example.true_ids), np.maximum(self.example.areas, _TINY))
        return out[:count]

    def pair_truth(self) -> tuple[np.ndarray, np.ndarray]:
        """Return 1 for pairs of one thing, and the weights of pairs, float (e,) each."""
        table = self.table()
        area = table.sum(axis=1)
        ids = table.argmax(axis=1)
        ids = np.where(ids <= self.example.base_entities, np.minimum(ids, 1), ids)
        pure = table.max(axis=1, initial=0.0) > _PURE * area
        weight = np.clip(area / _CRUMB_M2, 0.0, 1.0) * pure
        a, b = self.pieces.graph.pairs.T
        return (ids[a] == ids[b]).astype(float), np.minimum(weight[a], weight[b])


@dataclass(frozen=True)
class RoomProposals:
    """One room's proposals and how well they are true things."""

    proposals: Proposals
    rows: np.ndarray  # float32 (m, F)
    best_iou: (
        np.ndarray
    )  # float (m,) mean IoU of surface and of boxes with the true thing that each is most like
    best_thing: np.ndarray  # int (m,) that thing
    links: np.ndarray  # int (e, 2) pairs of clusters
    odds: np.ndarray  # float32 (e,) log-odds that both are of one thing
    region: np.ndarray  # int (v,) cluster of each vertex
    example: Example

    @property
    def members(self) -> csr_matrix:
        """Return the clusters (m, n) of each proposal."""
        return self.proposals.members


def examples_of(rooms: Sequence[Room], cache: Path, sources: Sources, processes: int) -> list[Example]:
    """Return each room's graph of superpoints with its truth (`priors.partition_rooms.example`), cached."""
    return in_processes(_example, [(room, cache, sources) for room in rooms], processes)


def _example(job: tuple[Room, Path, Path | None]) -> Example:
    return example(*job)


def clusters_of(
    rooms: Sequence[Room],
    examples: Sequence[Example],
    models: Sequence[Ensemble],
    cache: Path,
    processes: int,
) -> list[Clusters]:
    """Return the clusters of each room.

    Args:
        rooms: arrays on disk.
        examples: their graphs of superpoints.
        models: for each room what partitions it; networks that were trained on a room make other clusters there than
            elsewhere, so that it is one that was not.
        cache: folder with the fused surfaces.
        processes: at work at once.
    """
    found = in_processes(
        _clusters, [(*job, cache) for job in zip(rooms, examples, models, strict=True)], processes
    )
    return [Clusters(room, example, *values) for room, example, values in zip(rooms, examples, found)]


def proposals_of(
    found: Sequence[Clusters], trees: Sequence[Boosted], cache: Path, processes: int
) -> list[RoomProposals]:
    """Return the proposals of each room by trees for pairs that were not fitted to it."""
    return in_processes(_proposals, [(*job, cache) for job in zip(found, trees, strict=True)], processes)


def shipped_proposals(
    rooms: Sequence[Room], cache: Path, sources: Sources, processes: int
) -> list[RoomProposals]:
    """Return the proposals of each room by the networks and trees for pairs that ship, cached."""
    return in_processes(_shipped_proposals_of, [(room, cache, sources) for room in rooms], processes)


def _shipped_proposals_of(job: tuple[Room, Path, Path | None]) -> RoomProposals:
    room, cache, sources = job
    models, known = load_models(), example(room, cache, sources)
    digest = digest_of(["reconstruction.instances.partition.cut"])  # weights included
    file = cached(room, cache, f"proposals-{digest}").with_suffix(".npz")
    if not file.is_file():
        view = room_view(room, cache)
        found = Clusters(room, known, *_clustered(view, known, models.superpoints))
        made = _proposed(view, found, models.pairs)
        kept = {name: value for name, value in vars(made).items() if isinstance(value, np.ndarray)}
        members, low, high = made.members, made.proposals.low, made.proposals.high
        parts = {"indices": members.indices, "indptr": members.indptr, "count": np.array(members.shape[1])}
        write_arrays(file, **kept, **parts, low=low, high=high)
    with np.load(file) as stored:
        arrays = dict(stored)
    indices, indptr, count = (arrays.pop(name) for name in ("indices", "indptr", "count"))
    members = csr_matrix((np.ones(len(indices)), indices, indptr), shape=(len(indptr) - 1, int(count)))
    return RoomProposals(Proposals(members, arrays.pop("low"), arrays.pop("high")), **arrays, example=known)


def in_processes(work: Callable[[J], T], jobs: list[J], processes: int) -> list[T]:
    """Return work(job) of each job, by a number of processes of one thread each."""
    if processes == 1:
        return [work(job) for job in jobs]
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn"), initializer=_alone) as pool:
        return list(pool.map(work, jobs))


def _alone() -> None:
    import cv2
    import numba
    import torch

    numba.set_num_threads(1)
    cv2.setNumThreads(1)
    torch.set_num_threads(1)


def _clusters(job: tuple[Room, Example, Ensemble, Path]) -> tuple[Scores, np.ndarray, ClusterGraph]:
    room, known, model, cache = job
    return _clustered(room_view(room, cache), known, model)


def _clustered(view: View, known: Example, model: Ensemble) -> tuple[Scores, np.ndarray, ClusterGraph]:
    scores = model.scores(known.nodes, known.edges, known.pairs)
    label, cluster = partition_with_labels(known.pairs, scores.affinity, scores.label)
    area = np.bincount(known.region, weights=known.areas, minlength=len(label))
    label, cluster = with_parts_of_base(known.pairs, scores.affinity, area, label, cluster)
    return scores, label, cluster_graph(view, region_graph(view.mesh), scores, label, cluster)


def _proposals(job: tuple[Clusters, Boosted, Path]) -> RoomProposals:
    found, trees, cache = job
    return _proposed(room_view(found.room, cache), found, trees)


def _proposed(view: View, found: Clusters, trees: Boosted) -> RoomProposals:
    """Return a room's proposals by trees for pairs."""
    odds = trees(found.pieces.pair_rows())
    proposals = propose(view, found.pieces, odds)
    rows = proposal_features(
        view, region_graph(view.mesh), found.scores, found.label, found.pieces, odds, proposals
    )
    e, inside = found.example, proposals.members @ found.table()
    whole = np.bincount(e.true_ids, weights=np.maximum(e.areas, _TINY), minlength=len(e.pixels))
    iou = inside / np.maximum(inside.sum(axis=1)[:, None] + whole - inside, _TINY)
    boxes = _boxes(view.mesh.points, found.pieces.graph.region, proposals.members)
    iou = 0.5 * (iou + np.nan_to_num(box_iou(boxes, e.boxes)))
    of_things = iou[:, int(e.base_entities) + 1 :]
    best = of_things.max(axis=1, initial=0.0)
    thing = of_things.argmax(axis=1) if of_things.size else np.zeros(len(best), np.int64)
    graph = found.pieces.graph
    return RoomProposals(proposals, rows, best, thing, graph.pairs, odds, graph.region, e)


def _boxes(points: np.ndarray, region: np.ndarray, members: csr_matrix) -> np.ndarray:
    """Return the trimmed boxes (m, 2, 3) of sets of clusters (m, n); `region` is the cluster of each point."""
    order = np.argsort(region, kind="stable")
    first = np.searchsorted(region[order], np.arange(members.shape[1] + 1))
    own = [points[order[a:b]] for a, b in pairwise(first)]
    out = np.empty((members.shape[0], 2, 3))
    for row, (start, end) in enumerate(pairwise(members.indptr)):
        inside = np.concatenate([own[k] for k in members.indices[start:end]])
        out[row] = np.percentile(inside, (TRIMMED, 100 - TRIMMED), axis=0)
    return out
