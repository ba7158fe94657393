"""Segmentation by the learned partition: score, partition, propose, choose; then assign base planes and supports."""

import numpy as np
from scipy.sparse import csr_matrix

from reconstruction.core.progress import Progress
from reconstruction.core.types import Surface
from reconstruction.instances.config import InstancesConfig
from reconstruction.instances.contacts import carriers
from reconstruction.instances.cut import Cut, Shell, Thing
from reconstruction.instances.mask_cut import mark_attached
from reconstruction.instances.partition.base_parts import with_parts_of_base
from reconstruction.instances.partition.choice import likeliest_things
from reconstruction.instances.partition.clusters import ClusterGraph, cluster_graph
from reconstruction.instances.partition.crop_scores import cluster_areas, estimated_iou
from reconstruction.instances.partition.duplicates import proposal_pairs
from reconstruction.instances.partition.features import Shapes, Together, View, edge_features, node_features
from reconstruction.instances.partition.graph import LABELS, RegionGraph, region_graph
from reconstruction.instances.partition.model import Models, load_models
from reconstruction.instances.partition.multicut import partition_with_labels
from reconstruction.instances.partition.proposal_features import proposal_features
from reconstruction.instances.partition.proposals import propose
from reconstruction.instances.sightings import Sighting

_THING, _BASE, _ARTIFACT = (LABELS.index(name) for name in ("thing", "base", "artifact"))
UNCLAIMED = len(LABELS)
"""Row after the rows of LABELS, of surface that is of a thing, but of no object that was chosen."""


def cut_by_partition(
    shell: Shell, surface: Surface, frames: list[Sighting], config: InstancesConfig, progress: Progress
) -> Cut:
    """Partition the surface into base, objects and artifacts by learned affinities.

    Args:
        shell: the surface graph and its base planes.
        surface: the same surface in world space.
        frames: keyframes with the surface rendered into them.
        config: the least size of objects.
        progress: receives a note with the counts.

    Raises:
        EnvironmentMissing: the weights cannot be read.
    """
    models = load_models()
    label, cluster = np.zeros(0, np.int32), np.zeros(0, np.int32)
    if len(shell.graph.edges):
        view = View.of(shell.graph, surface, frames)
        label, cluster = partition_surface(view, region_graph(shell.graph), models)
    chosen = clusters_of_things(shell.graph.areas, label, cluster, config)
    things = [Thing(np.flatnonzero(cluster == number)) for number in chosen]
    for thing, carrier in zip(things, carriers(shell.graph, [t.vertices for t in things])):
        thing.rests_on = things[carrier] if carrier >= 0 else None
    mark_attached(shell, things)
    neither = float(shell.graph.areas[label > _BASE].sum() / max(shell.graph.areas.sum(), 1e-12))
    progress.note(
        f"One partition of the surface: {len(things)} things; {neither:.0%} of it is neither thing nor base"
    )
    return Cut(things, _base_owner(shell, label), artifact=label == _ARTIFACT if len(label) else None)


def partition_surface(view: View, graph: RegionGraph, models: Models) -> tuple[np.ndarray, np.ndarray]:
    """Return the row in LABELS, or UNCLAIMED, and the cluster of each vertex, int32 (v,) each.

    Superpoints are partitioned into clusters by a multicut. Merge trees of the "thing" clusters, and of parts of the
    base, give proposals, of which boosted trees choose the likeliest. Those are scored as keyframes show them, and the
    disjoint ones with the highest total score, less what pairs of them count twice, are objects. "Thing" clusters in
    none of them are unclaimed, parts of the base stay base.
    """
    scores = models.superpoints.scores(*features(view, graph), graph.pairs)
    label, cluster = partition_with_labels(graph.pairs, scores.affinity, scores.label)
    area = np.bincount(graph.region, weights=view.mesh.areas, minlength=graph.count)
    as_thing, parts = with_parts_of_base(graph.pairs, scores.affinity, area, label, cluster)
    pieces = cluster_graph(view, graph, scores, as_thing, parts)
    odds = models.pairs(pieces.pair_rows())
    proposals = propose(view, pieces, odds)
    rows = proposal_features(view, graph, scores, as_thing, pieces, odds, proposals)
    by_trees = models.proposals(rows)
    shown, by_crops = models.crops(view, pieces.graph.region, proposals.members, by_trees)
    likely, iou = proposals.taken(shown), estimated_iou(by_trees[shown], by_crops)
    areas = cluster_areas(view.mesh.areas, pieces.graph.region, likely.members)
    twice = proposal_pairs(likely, iou, areas, pieces.graph.pairs, odds).counted_twice(models.duplicates)
    thing = things_of(likely.members[likeliest_things(likely.members, iou, twice)], pieces)
    return labels_of(thing, label[graph.region], cluster[graph.region])


def things_of(members: csr_matrix, pieces: ClusterGraph) -> np.ndarray:
    """Return the object int (v,) of each vertex, from 1, 0 = none, for disjoint sets of clusters (m, n)."""
    number = np.zeros(pieces.things + 1, np.int64)
    number[members.indices] = 1 + np.repeat(np.arange(members.shape[0]), np.diff(members.indptr))  # pyright: ignore[reportOptionalSubscript]
    return number[pieces.graph.region]


def labels_of(thing: np.ndarray, label: np.ndarray, cluster: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return label and cluster of each vertex after the choice of objects, whose cluster numbers come last.

    Args:
        thing: int (v,) object of each vertex, from 1, 0 = none.
        label: int (v,) row in LABELS after the multicut.
        cluster: int (v,) cluster after the multicut.
    """
    own = np.where(thing > 0, _THING, np.where(label == _THING, UNCLAIMED, label))
    number = np.where(thing > 0, int(cluster.max(initial=-1)) + thing, cluster)
    return own.astype(np.int32), _one_label_each(own, number)


def _one_label_each(label: np.ndarray, cluster: np.ndarray) -> np.ndarray:
    """Return cluster numbers int32 (v,) from 0, split so that each cluster has one label."""
    return np.unique(cluster * (UNCLAIMED + 1) + label, return_inverse=True)[1].astype(np.int32)


def features(view: View, graph: RegionGraph) -> tuple[np.ndarray, np.ndarray]:
    """Return the features of the superpoints and of the borders of a graph."""
    shapes = Shapes.of(view.mesh, graph)
    together = Together.of(view, graph)
    return node_features(view, graph, shapes, together), edge_features(view, graph, shapes, together)


def clusters_of_things(
    areas: np.ndarray, label: np.ndarray, cluster: np.ndarray, config: InstancesConfig
) -> np.ndarray:
    """Return the clusters labeled "thing" that have the least size of the config."""
    thing = label == _THING
    count = int(cluster.max()) + 1 if len(cluster) else 0
    vertices = np.bincount(cluster[thing], minlength=count)
    area = np.bincount(cluster[thing], weights=areas[thing], minlength=count)
    return np.flatnonzero((vertices >= config.min_object_vertices) & (area >= config.min_object_area_m2))


def _base_owner(shell: Shell, label: np.ndarray) -> np.ndarray:
    """Return the base entity int32 (v,) of each vertex: the plane it is on, or the nearest; 0 if it is not base."""
    owner = np.zeros(len(shell.graph.points), np.int32)
    base = np.flatnonzero(label == _BASE) if len(label) else owner[:0]
    if not shell.planes or not len(base):
        return owner
    distance = np.stack([np.abs(plane.distance(shell.graph.points[base])) for plane in shell.planes])
    numbers = np.array([shell.entity_id(k) for k in range(len(shell.planes))], np.int32)
    owner[base] = np.where(shell.owner[base] > 0, shell.owner[base], numbers[np.argmin(distance, axis=0)])
    return owner
