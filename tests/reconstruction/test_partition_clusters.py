"""Graphs of clusters: pieces of one thing that do not touch, and features that only whole pieces have."""

import itertools

import numpy as np
import pytest
from fused_surfaces import box, fused
from surfaces import frames_of, with_planes

from reconstruction.core.progress import NO_PROGRESS
from reconstruction.instances.cut import Shell
from reconstruction.instances.partition import clusters
from reconstruction.instances.partition.clusters import (
    CLUSTER_FEATURES,
    PAIR_FEATURES,
    REACH_M,
    ClusterGraph,
    cluster_graph,
)
from reconstruction.instances.partition.cut import partition_surface
from reconstruction.instances.partition.features import View
from reconstruction.instances.partition.graph import LABELS, Scores, region_graph
from reconstruction.instances.partition.model import load_models
from reconstruction.instances.partition.proposal_features import PROPOSAL_FEATURES, proposal_features
from reconstruction.instances.partition.proposals import propose
from reconstruction.instances.sightings import sightings

THING, BASE = LABELS.index("thing"), LABELS.index("base")
LEFT = box((-0.45, -0.1, 0.3), (-0.30, 0.1, 0.4), (150, 60, 40))
RIGHT = box((-0.18, -0.1, 0.3), (-0.05, 0.1, 0.4), (150, 60, 40))
FAR = box((REACH_M + 0.05, -0.1, 0.3), (0.45, 0.1, 0.4), (40, 60, 150))


@pytest.fixture(scope="module")
def boards():
    surface = with_planes(fused([LEFT, RIGHT, FAR]))
    posed, depth = frames_of(surface)
    shell = Shell.of(surface, NO_PROGRESS)
    view = View.of(shell.graph, surface, sightings(surface, posed, depth))
    graph = region_graph(view.mesh)
    size = np.bincount(graph.region)
    center = np.stack([np.bincount(graph.region, weights=x) / size for x in view.mesh.points.T], axis=1)
    label = np.where(center[:, 2] > 0.25, THING, BASE)
    cluster = np.where(label == THING, 1 + (center[:, 0] > -0.24) + (center[:, 0] > 0.1), 0)
    return view, graph, label, cluster


def pieces_of(boards, affinity=None) -> ClusterGraph:
    view, graph, label, cluster = boards
    said = np.log(np.where(label[:, None] == np.arange(len(LABELS)), 0.98, 0.01)).astype(np.float32)
    if affinity is None:
        affinity = np.zeros(len(graph.pairs), np.float32)
    return cluster_graph(view, graph, Scores(affinity, said), label, cluster)


def test_clusters_within_reach_are_compared_and_others_are_not(boards):
    pieces = pieces_of(boards)
    graph = pieces.graph
    assert graph.count == 4  # and all that is no thing
    assert pieces.nodes.shape == (4, len(CLUSTER_FEATURES))
    assert pieces.edges.shape == (len(graph.pairs), len(PAIR_FEATURES))
    assert np.isfinite(pieces.nodes).all()
    assert np.isfinite(pieces.edges).all()
    middle = [np.median(boards[0].mesh.points[graph.region == k, 0]) for k in range(3)]
    left, right, far = np.argsort(middle)
    joined = {tuple(pair) for pair in graph.pairs.tolist()}
    assert joined == {tuple(sorted((int(left), int(right))))}
    assert not any(far in pair for pair in joined)


def test_the_gap_is_measured_and_seen_through(boards):
    pieces = pieces_of(boards)
    (row,) = pieces.edges
    said = dict(zip(PAIR_FEATURES, row.tolist()))
    assert said["far_gap"] == pytest.approx(0.12, abs=0.02)
    assert said["nearest"] == 2.0
    assert said["foot_step"] == pytest.approx(0.0, abs=0.02)
    assert said["inside_hull"] == 0.0
    assert said["hull_growth"] > 0.1  # the gap between both
    assert said["histogram"] > 0.5  # one paint
    assert said["log_odds_sum"] == 0.0  # they share no border
    assert said["hidden_between"] + said["free_between"] + said["surface_between"] == pytest.approx(1.0)


def test_summed_odds_are_those_of_the_borders_between_two_clusters(boards):
    view, graph, label, cluster = boards
    halves = np.where(label == THING, 1 + 2 * (cluster - 1) + (np.arange(graph.count) % 2), 0)
    odds = np.random.default_rng(0).normal(size=len(graph.pairs)).astype(np.float32)
    pieces = pieces_of((view, graph, label, halves), odds)
    ends = np.sort(halves[graph.pairs], axis=1)
    numbers = [int(halves[graph.region[np.flatnonzero(pieces.graph.region == k)[0]]]) for k in range(6)]
    checked = 0
    for (a, b), row in zip(pieces.graph.pairs, pieces.edges):
        across = (ends == sorted((numbers[a], numbers[b]))).all(axis=1)
        said = dict(zip(PAIR_FEATURES, row.tolist()))
        if across.any():
            total = odds[across].sum()
            assert said["log_odds_sum"] == pytest.approx(np.sign(total) * np.log1p(abs(total)), abs=1e-4)
            assert said["log_odds_most"] == pytest.approx(odds[across].max(), abs=1e-5)
            checked += 1
    assert checked >= 3


def test_small_clusters_are_compared_with_near_ones_only():
    """Pairs grow with the number of clusters, not with its square."""
    box = np.random.default_rng(0).uniform(0, 2, (300, 1, 3)) + np.array([[0.0], [0.01]])
    box[0] = [[0, 0, 0], [2, 2, 0.1]]
    size = np.linalg.norm(box[:, 1] - box[:, 0], axis=1)
    found = {(a, b): reach for a, b, reach in clusters.boxes_in_reach(box, size)}
    for a, b in itertools.combinations(range(300), 2):
        gap = np.linalg.norm(np.maximum(np.maximum(box[a, 0] - box[b, 1], box[b, 0] - box[a, 1]), 0))
        assert ((a, b) in found) == (gap < max(0.02, min(size[a], size[b])))
    pairs = np.array(list(itertools.combinations(range(30), 2)))
    kept = clusters.among_nearest(pairs, np.abs(pairs[:, 0] - pairs[:, 1]).astype(float))
    away = np.abs(pairs[:, 0] - pairs[:, 1])
    assert kept[away <= clusters.NEAREST // 2].all()
    assert not kept[away > clusters.NEAREST].any()


def test_features_of_pairs_do_not_depend_on_the_order_of_clusters(boards):
    view, graph, label, cluster = boards
    turned = np.where(label == THING, 4 - cluster, 0)
    first, second = pieces_of(boards), pieces_of((view, graph, label, turned))
    np.testing.assert_allclose(first.edges, second.edges, atol=1e-4)
    np.testing.assert_array_equal(first.graph.count - 2 - first.graph.region[first.graph.region < 3],
                                  second.graph.region[second.graph.region < 3])  # fmt: skip


def test_nothing_but_base_has_no_clusters(boards):
    view, graph, label, _ = boards
    pieces = pieces_of((view, graph, np.full_like(label, BASE), np.zeros_like(label)))
    assert pieces.graph.count == 1
    assert pieces.edges.shape == (0, len(PAIR_FEATURES))
    odds = load_models().pairs(pieces.pair_rows())
    assert odds.shape == (0,)
    proposals = propose(view, pieces, odds)
    assert proposals.members.shape == (0, 0)
    scores = Scores(np.zeros(len(graph.pairs), np.float32), np.zeros((graph.count, len(LABELS)), np.float32))
    rows = proposal_features(view, graph, scores, np.full_like(label, BASE), pieces, odds, proposals)
    assert rows.shape == (0, len(PROPOSAL_FEATURES))


def test_each_cluster_of_the_cut_has_one_label(boards):
    """Each cluster of vertices has one label."""
    view, graph, _, _ = boards
    label, cluster = partition_surface(view, graph, load_models())
    assert len(label) == len(cluster) == len(view.mesh.points)
    for number in np.unique(cluster):
        assert len(np.unique(label[cluster == number])) == 1
