"""Graph of the multicut's clusters, with features of clusters and of pairs that may be pieces of one object.

Occlusion and unmeasured surface split an object into pieces without a common border. So clusters are joined within a
reach, and get features that only whole pieces have (agglomeration on learned region features: Nunez-Iglesias et al.,
Machine learning of hierarchical clustering, PLoS ONE 2013).
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull, QhullError, cKDTree  # pyright: ignore[reportAttributeAccessIssue]

from reconstruction.instances.partition.features import (
    EDGE_FEATURES,
    NODE_FEATURES,
    Shapes,
    Together,
    View,
    edge_features,
    node_features,
)
from reconstruction.instances.partition.graph import LABELS, RegionGraph, Scores, graph_of_links

REACH_M = 0.25  # two clusters form a pair if their gap is at most this,
REACH_OF_SIZE = 1.0  # and at most this times the diagonal of the smaller one,
NEAREST = 8  # and one of them is among this many nearest neighbors of the other;
_TOUCHING_M = 0.02  # within this gap they always form a pair
LEAST_AREA_M2 = 2e-4  # smaller clusters are dropped
CLUSTER_FEATURES = (
    *NODE_FEATURES, "log_thing", "log_base", "log_artifact", "log_regions", "border_base", "border_artifact",
    "border_things", "solidity", "log_diagonal", "tall", "sole_size",
)  # fmt: skip
PAIR_FEATURES = (
    *EDGE_FEATURES, "far_gap", "gap_of_size", "log_odds_sum", "log_odds_mean", "log_odds_most", "inside_box",
    "inside_hull", "hull_growth", "thickness_growth", "plan_overlap", "height_overlap", "foot_step", "top_step",
    "center_step", "size_ratio", "union_of_size", "hidden_between", "free_between", "surface_between", "histogram",
    "nearest", "steepness",
)  # fmt: skip
_SAMPLES = 160  # vertices of a cluster from which hulls and boxes are computed
_PAD_M = 0.004  # padding of the points of convex hulls, so that sheets have a volume
_INSIDE_M = 0.01  # tolerance of tests whether points are inside a box or a hull
CLIP_ODDS = 20.0
_STEPS = (0.2, 0.35, 0.5, 0.65, 0.8)  # sample positions between the nearest points of two clusters
_AGREES = 0.015  # of the depth: measured depth within this of a sample is surface
_BINS = 8  # of the color histogram, per channel
_TINY = 1e-9


@dataclass(frozen=True)
class ClusterGraph:
    """Graph of the clusters labeled "thing"; all other vertices are the last region, which has no pairs."""

    graph: RegionGraph
    things: int  # number of these clusters
    nodes: np.ndarray  # float32 (n, len(CLUSTER_FEATURES))
    edges: np.ndarray  # float32 (e, len(PAIR_FEATURES))

    def pair_rows(self) -> np.ndarray:
        """Return float32 (e, F): features of pairs, sums and absolute differences of the features of both ends."""
        first, second = (self.nodes[ends] for ends in self.graph.pairs.T)
        return np.concatenate([self.edges, first + second, np.abs(first - second)], axis=1)


def cluster_graph(
    view: View, graph: RegionGraph, scores: Scores, label: np.ndarray, cluster: np.ndarray
) -> ClusterGraph:
    """Return the graph of the clusters labeled "thing", with features.

    Args:
        view: the surface and its keyframes.
        graph: its superpoint graph.
        scores: scores of that graph.
        label: int (n,) row in LABELS of each superpoint.
        cluster: int (n,) cluster of each superpoint.
    """
    node = _numbered(view, graph, label, cluster)
    rest = int(node.max(initial=-1)) + 1
    node = np.where(node >= 0, node, rest)
    pieces = _Pieces.of(view, node[graph.region], rest)
    pairs, ends, gaps = _near_pairs(view, pieces)
    merged = _joined(graph, node, rest, pairs, ends)
    shapes, together = Shapes.of(view.mesh, merged), Together.of(view, merged)
    nodes = np.column_stack(
        [node_features(view, merged, shapes, together), _of_nodes(view, graph, scores, label, node, rest, pieces)]
    )  # fmt: skip
    edges = np.column_stack(
        [edge_features(view, merged, shapes, together),
         _of_pairs(view, graph, scores, node, rest, pieces, shapes, merged.pairs, ends, gaps)]
    )  # fmt: skip
    return ClusterGraph(merged, rest, nodes.astype(np.float32), edges.astype(np.float32))


def _numbered(view: View, graph: RegionGraph, label: np.ndarray, cluster: np.ndarray) -> np.ndarray:
    """Return the node of each superpoint, from 0; -1 for superpoints of other labels or of small clusters."""
    thing = label == LABELS.index("thing")
    area = np.bincount(graph.region, weights=view.mesh.areas, minlength=graph.count)
    size = np.bincount(cluster, weights=np.where(thing, area, 0.0))
    kept = size >= LEAST_AREA_M2
    number = np.where(kept, np.cumsum(kept) - 1, -1)
    return np.where(thing, number[cluster], -1)


@dataclass(frozen=True)
class _Pieces:
    """Samples and convex hulls of each cluster."""

    points: list[np.ndarray]  # float64 (k, 3), k <= _SAMPLES
    vertices: list[np.ndarray]  # int (k,) of these points
    trees: list[cKDTree]  # of all vertices
    all_vertices: list[np.ndarray]
    box: np.ndarray  # float64 (n, 2, 3) low, high
    volume: np.ndarray  # float64 (n,) of the padded hull
    hulls: list[np.ndarray | None]  # float64 (facets, 4) planes, normals outward

    @classmethod
    def of(cls, view: View, node: np.ndarray, count: int) -> "_Pieces":
        order = np.argsort(node, kind="stable")
        first = np.searchsorted(node[order], np.arange(count + 1))
        every = [order[first[k] : first[k + 1]] for k in range(count)]
        sampled = [v[np.linspace(0, len(v) - 1, min(len(v), _SAMPLES)).astype(int)] for v in every]
        points = [view.mesh.points[v] for v in sampled]
        box = np.array([(p.min(axis=0), p.max(axis=0)) for p in points]).reshape(-1, 2, 3)
        hulls = [_hull(p) for p in points]
        return cls(
            points, sampled, [cKDTree(view.mesh.points[v]) for v in every], every, box,
            np.array([volume for volume, _ in hulls]), [planes for _, planes in hulls],
        )  # fmt: skip


def _hull(points: np.ndarray) -> tuple[float, np.ndarray | None]:
    """Return volume and planes of the convex hull of points, each padded by `_PAD_M`."""
    corners = _PAD_M * np.array([(1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)])
    try:
        hull = ConvexHull((points[:, None] + corners).reshape(-1, 3))
    except QhullError:
        return _PAD_M**3, None
    return hull.volume, hull.equations


def _near_pairs(view: View, pieces: _Pieces) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return pairs of nodes (e, 2), their nearest vertices (e, 2), and the gaps (e,) in metres."""
    size = np.linalg.norm(pieces.box[:, 1] - pieces.box[:, 0], axis=1)
    pairs, ends, gaps = [], [], []
    for a, b, reach in boxes_in_reach(pieces.box, size):
        small, large = (a, b) if len(pieces.all_vertices[a]) <= len(pieces.all_vertices[b]) else (b, a)
        points = view.mesh.points[pieces.all_vertices[small]]
        distance, found = pieces.trees[large].query(points, distance_upper_bound=reach)
        row = int(np.argmin(distance))
        if distance[row] < reach:
            pairs.append((a, b))
            p, q = pieces.all_vertices[small][row], pieces.all_vertices[large][found[row]]
            ends.append((p, q) if small == a else (q, p))
            gaps.append(distance[row])
    pairs, ends, gaps = (
        np.array(pairs, np.int64).reshape(-1, 2), np.array(ends, np.int64).reshape(-1, 2), np.array(gaps, float)
    )  # fmt: skip
    kept = (gaps < _TOUCHING_M) | among_nearest(pairs, gaps)
    return pairs[kept], ends[kept], gaps[kept]


def boxes_in_reach(box: np.ndarray, size: np.ndarray) -> Iterator[tuple[int, int, float]]:
    """Yield pairs of boxes float (n, 2, 3) within reach of each other, and their reach in metres."""
    reach = np.clip(REACH_OF_SIZE * size, _TOUCHING_M, REACH_M)
    for a in range(len(box)):
        apart = np.maximum(box[a, 0] - box[a + 1 :, 1], box[a + 1 :, 0] - box[a, 1])
        allowed = np.minimum(reach[a], reach[a + 1 :])
        for k in np.flatnonzero(np.linalg.norm(np.maximum(apart, 0.0), axis=1) < allowed):
            yield a, a + 1 + int(k), float(allowed[k])


def among_nearest(pairs: np.ndarray, gaps: np.ndarray) -> np.ndarray:
    """Return which pairs (e, 2) have an end that is among the `NEAREST` neighbors of the other end."""
    ends, row = pairs.T.ravel(), np.tile(np.arange(len(pairs)), 2)
    order = np.lexsort((row, gaps[row], ends))
    first = np.searchsorted(ends[order], ends[order])
    out = np.zeros(len(pairs), bool)
    out[row[order[np.arange(len(order)) - first < NEAREST]]] = True
    return out


def _joined(
    graph: RegionGraph, node: np.ndarray, rest: int, pairs: np.ndarray, ends: np.ndarray
) -> RegionGraph:
    """Return the graph of nodes with the links of the superpoint graph, and one link per pair without any."""
    region = node[graph.region].astype(np.int32)
    first, second = region[graph.links[:, 0]], region[graph.links[:, 1]]
    across = (first != second) & (first != rest) & (second != rest)
    links, touching = graph.links[across], graph.touching[graph.link_pair][across]
    low, high = np.minimum(first, second)[across].astype(np.int64), np.maximum(first, second)[across]
    within = np.isin(low * (rest + 1) + high, pairs[:, 0] * (rest + 1) + pairs[:, 1])
    links, touching = links[within], touching[within]
    linked = np.unique((low * (rest + 1) + high)[within])
    far = ~np.isin(pairs[:, 0] * (rest + 1) + pairs[:, 1], linked)
    return graph_of_links(
        region, np.concatenate([links, ends[far].astype(np.int32)]), np.r_[touching, np.zeros(far.sum(), bool)],
        int(node.max()) + 1,
    )  # fmt: skip


def _of_nodes(
    view: View, graph: RegionGraph, scores: Scores, label: np.ndarray, node: np.ndarray, rest: int, pieces: _Pieces
) -> np.ndarray:  # fmt: skip
    """Return the node features beyond `NODE_FEATURES`, float (count, k)."""
    count = int(node.max()) + 1
    area = np.maximum(np.bincount(graph.region, weights=view.mesh.areas, minlength=graph.count), _TINY)
    total = np.maximum(np.bincount(node, weights=area, minlength=count), _TINY)
    said = np.stack(
        [np.bincount(node, weights=area * said, minlength=count) / total for said in scores.label.T], axis=1
    )
    a, b = graph.pairs[:, 0], graph.pairs[:, 1]
    links = np.bincount(graph.link_pair, minlength=len(graph.pairs))
    border = np.zeros((count, 3))  # towards base, artifact, other clusters
    for own, other in ((a, b), (b, a)):
        across = node[own] != node[other]
        kind = np.where(label[other] == 0, 2, label[other] - 1)
        np.add.at(border, (node[own][across], kind[across]), links[across])
    border /= np.maximum(border.sum(axis=1, keepdims=True), 1.0)
    box = np.concatenate([pieces.box, np.zeros((count - rest, 2, 3))])
    sides = box[:, 1] - box[:, 0]
    diagonal = np.log(np.linalg.norm(sides, axis=1) + _TINY + 1e-3)
    volume = np.r_[pieces.volume, np.ones(count - rest)]
    solidity = np.log(total) - np.log(np.maximum(volume, _TINY)) * 2 / 3
    tall = sides[:, 2] / (sides[:, :2].max(axis=1) + sides[:, 2] + 1e-3)
    regions = np.log(np.maximum(np.bincount(node, minlength=count), 1))
    return np.column_stack(
        [said, regions, border, solidity, diagonal, tall, np.sqrt(sides[:, 0] * sides[:, 1])]
    )


def _of_pairs(
    view: View, graph: RegionGraph, scores: Scores, node: np.ndarray, rest: int, pieces: _Pieces, shapes: Shapes,
    pairs: np.ndarray, ends: np.ndarray, gaps: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Return the pair features beyond `EDGE_FEATURES`, float (e, k)."""
    a, b = pairs[:, 0].astype(np.int64), pairs[:, 1].astype(np.int64)
    low, high = pieces.box[:, 0], pieces.box[:, 1]
    size = np.linalg.norm(high - low, axis=1) + 1e-3
    smaller = np.minimum(size[a], size[b])
    union = np.linalg.norm(np.maximum(high[a], high[b]) - np.minimum(low[a], low[b]), axis=1)
    overlap = np.minimum(high[a], high[b]) - np.maximum(low[a], low[b])
    shorter = np.minimum((high - low)[a], (high - low)[b]) + 0.005
    step = view.mesh.points[ends[:, 1]] - view.mesh.points[ends[:, 0]]
    odds = _summed_odds(graph, scores, node, rest, a, b)
    hulls = np.array([_hull_features(pieces, i, j) for i, j in zip(a, b)]).reshape(-1, 3)
    thick = np.array([_thickness(pieces.points[i], pieces.points[j]) for i, j in zip(a, b)])
    thicker = np.maximum(shapes.spread[a, 0], shapes.spread[b, 0])
    histogram = _histograms(view, pieces)
    nearest = np.full(rest + 1, np.inf)
    np.minimum.at(nearest, np.r_[a, b], np.r_[gaps, gaps])
    return np.column_stack(
        [gaps, gaps / smaller, odds, hulls, np.log((thick + 1e-3) / (thicker + 1e-3)),
         np.clip(overlap[:, :2] / shorter[:, :2], -2, 1).min(axis=1), np.clip(overlap[:, 2] / shorter[:, 2], -2, 1),
         np.abs(low[a, 2] - low[b, 2]), np.abs(high[a, 2] - high[b, 2]),
         np.linalg.norm(shapes.center[a] - shapes.center[b], axis=1) / smaller,
         np.log(smaller / np.maximum(size[a], size[b])), np.log(union / np.maximum(size[a], size[b])),
         _between(view, ends), (np.sqrt(histogram[a] * histogram[b])).sum(axis=1),
         (gaps <= nearest[a] + 1e-6).astype(float) + (gaps <= nearest[b] + 1e-6),
         np.abs(step[:, 2]) / np.maximum(np.linalg.norm(step, axis=1), _TINY)]
    )  # fmt: skip


def _summed_odds(
    graph: RegionGraph, scores: Scores, node: np.ndarray, rest: int, a: np.ndarray, b: np.ndarray
) -> np.ndarray:
    """Return sum (on a log scale), mean and maximum of the log-odds of borders between two nodes (e, 3), 0 for none."""
    ends = np.sort(node[graph.pairs].astype(np.int64), axis=1)
    keys, asked = ends[:, 0] * (rest + 1) + ends[:, 1], a * (rest + 1) + b
    row = np.searchsorted(asked, keys)
    there = (row < len(asked)) & (asked[np.minimum(row, len(asked) - 1)] == keys) if len(asked) else keys < 0
    odds, row = np.clip(scores.affinity[there].astype(np.float64), -CLIP_ODDS, CLIP_ODDS), row[there]
    count = np.bincount(row, minlength=len(asked))
    total = np.bincount(row, weights=odds, minlength=len(asked))
    most = np.full(len(asked), -np.inf)
    np.maximum.at(most, row, odds)
    return np.column_stack(
        [np.sign(total) * np.log1p(np.abs(total)), total / np.maximum(count, 1), np.where(count > 0, most, 0.0)]
    )  # fmt: skip


def _hull_features(pieces: _Pieces, a: int, b: int) -> tuple[float, float, float]:
    """Return shares of the smaller piece inside the other's box and hull, and the log growth of the common hull."""
    small, large = (a, b) if pieces.volume[a] <= pieces.volume[b] else (b, a)
    points = pieces.points[small]
    low, high = pieces.box[large] + _INSIDE_M * np.array([[-1.0], [1.0]])
    in_box = ((points > low) & (points < high)).all(axis=1).mean()
    planes, in_hull = pieces.hulls[large], 0.0
    if planes is not None:
        in_hull = ((points @ planes[:, :3].T + planes[:, 3]) < _INSIDE_M).all(axis=1).mean()
    volume = _hull(np.concatenate([pieces.points[a], pieces.points[b]]))[0]
    growth = np.log(max(volume, _TINY) / max(pieces.volume[a] + pieces.volume[b], _TINY))
    return float(in_box), float(in_hull), float(growth)


def _thickness(first: np.ndarray, second: np.ndarray) -> float:
    """Return the smallest standard deviation along the principal axes of the points of both pieces, metres."""
    points = np.concatenate([first, second])
    return float(np.sqrt(max(np.linalg.eigvalsh(np.cov(points.T))[0], 0.0))) if len(points) > 3 else 0.0


def _histograms(view: View, pieces: _Pieces) -> np.ndarray:
    """Return the normalized CIELAB histogram of each piece, float (n, bins^3)."""
    lab = view.mesh.lab.astype(np.float64)
    low, high = lab.min(axis=0), lab.max(axis=0) + _TINY
    cell = np.clip((_BINS * (lab - low) / (high - low)).astype(int), 0, _BINS - 1)
    key = (cell[:, 0] * _BINS + cell[:, 1]) * _BINS + cell[:, 2]
    return np.array([np.bincount(key[v], minlength=_BINS**3) / len(v) for v in pieces.vertices]).reshape(
        -1, _BINS**3
    )


def _between(view: View, ends: np.ndarray) -> np.ndarray:
    """Return the shares (e, 3) of samples between the nearest points of two nodes: occluded, free space, surface."""
    first, second = view.mesh.points[ends[:, 0]], view.mesh.points[ends[:, 1]]
    counts = np.zeros((len(ends), 3))
    for share in _STEPS:
        at = (1 - share) * first + share * second
        for frame in view.frames:
            row, column, z = frame.seen_at(at)
            measured = frame.measured[row, column]
            known = (z > 0) & (measured > 0)
            away = np.where(known, measured / np.maximum(z, _TINY) - 1.0, 0.0)
            for k, said in enumerate((away < -_AGREES, away > _AGREES, np.abs(away) <= _AGREES)):
                counts[:, k] += known & said
    return counts / np.maximum(counts.sum(axis=1, keepdims=True), 1.0)
