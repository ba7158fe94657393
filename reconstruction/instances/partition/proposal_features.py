"""Features of proposals: shape, color, and evidence inside them, along their borders and along their image contours.

Lengths are in metres, gravity is -z. Sums over clusters are matrix products with the members of the proposals.
"""
# pyright: reportOptionalSubscript=false
# SciPy's stubs let the shape of a sparse matrix be None.

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.sparse import csr_matrix
from scipy.spatial import ConvexHull, QhullError

from reconstruction.instances.partition.clusters import (
    CLIP_ODDS,
    CLUSTER_FEATURES,
    PAIR_FEATURES,
    ClusterGraph,
)
from reconstruction.instances.partition.features import View
from reconstruction.instances.partition.graph import LABELS, RegionGraph, Scores
from reconstruction.instances.partition.proposals import Proposals

_BESIDE = ("thing", "base", "artifact", "nothing")  # what is on the other side of a border or a contour
_CONTOUR = ("behind", "before", "level", "level_color", "level_odds", "color", "odds")
_BETWEEN = ("hidden_between", "free_between", "surface_between", "histogram")
PROPOSAL_FEATURES = (
    *CLUSTER_FEATURES,
    "log_area", "log_clusters", "largest",
    "spread_0", "spread_1", "spread_2", "flat", "long", "plan_short", "plan_long", "coherence", "normal_z",
    "normals_0", "normals_1", "upright", "up_share", "down_share", "color_sd_0", "color_sd_1", "color_sd_2",
    "foot", "top", "tall", "diagonal", "box_fill", "tall_of", "center_height",
    "hull", "solidity", "hull_cover", "hull_box", "hull_round",
    "in_mean", "in_sum", "in_least", "in_near", "in_negative", "out_mean", "out_sum", "out_most", "out_near",
    "out_positive", "near_count", "best_other", "best_other_sum", "best_large_other", "weakest_member",
    *(f"{side}_{name}" for name in _BETWEEN for side in ("in", "out")),
    *(f"border_{name}_{kind}" for kind in (*_BESIDE[:3], "all") for name in ("length", "height", "odds")),
    *(f"contour_{name}" for name in _CONTOUR),
    *(f"contour_{name}_{kind}" for kind in _BESIDE for name in ("share", *_CONTOUR[:5])),
    "pixels_most", "pixels_mean", "frames_share", "rim_best", "rim", "perimeter",
)  # fmt: skip
_SAMPLES, _HULL_SAMPLES = 60, 150  # vertices of a cluster, and of a proposal, from which hulls are computed
_PAD_M = 0.003  # padding of the points of convex hulls
_NEAR_M = 0.02  # largest gap of a "near" pair
_LARGE = 0.15  # of a proposal's area: least area of a large neighbor
_LEVEL = 0.03  # of the depth: least step at an occlusion boundary
_SHOWN_PX = 20  # least size in a keyframe that shows the proposal
_CLIP_BORDER, _CLIP_COLOR = 10.0, 40.0
_TINY = 1e-9


@dataclass(frozen=True)
class _Sums:
    """Members and areas of m proposals of n clusters, for sums over clusters."""

    members: csr_matrix  # float64 (m, n)
    region: np.ndarray  # int (v,) cluster of each vertex, n = none
    weight: np.ndarray  # float64 (v,) area, m2
    cluster_area: np.ndarray  # float64 (n,)
    area: np.ndarray  # float64 (m,)

    def mean(self, values: np.ndarray) -> np.ndarray:
        """Return the area-weighted means (m, k) of values (v, k) at vertices."""
        count = len(self.cluster_area)
        sums = [np.bincount(self.region, self.weight * c, count + 1)[:count] for c in values.T]
        return (self.members @ np.stack(sums, axis=1)) / self.area[:, None]

    def most(self, values: np.ndarray, lowest: float) -> np.ndarray:
        """Return the maximum (m,) of values (n,) over the clusters of each proposal."""
        return _row_most(self.members, values, lowest)


def proposal_features(
    view: View, graph: RegionGraph, scores: Scores, label: np.ndarray, pieces: ClusterGraph, odds: np.ndarray,
    proposals: Proposals,
) -> np.ndarray:  # fmt: skip
    """Return the features float32 (m, len(PROPOSAL_FEATURES)) of m proposals.

    Args:
        view: the surface and its keyframes.
        graph: its superpoint graph.
        scores: scores of that graph.
        label: int (s,) row in LABELS of each superpoint.
        pieces: the clusters, and pairs of them.
        odds: float (e,) log-odds that both clusters of a pair are one object.
        proposals: sets of clusters.
    """
    count, members = pieces.things, proposals.members
    if members.shape[0] == 0:
        return np.zeros((0, len(PROPOSAL_FEATURES)), np.float32)
    weight = np.maximum(view.mesh.areas, _TINY)
    cluster_area = np.bincount(pieces.graph.region, weight, count + 1)[:count]
    sums = _Sums(members, pieces.graph.region, weight, cluster_area, members @ cluster_area)
    means = (members @ (pieces.nodes[:count].astype(np.float64) * cluster_area[:, None])) / sums.area[:, None]
    size = [np.log(sums.area), np.log(np.diff(members.indptr)), sums.most(cluster_area, 0.0) / sums.area]
    kind = _kinds(graph, label, pieces)
    parts = [
        means, np.stack(size, axis=1), _shapes(view, sums), _boxes(view, sums, proposals),
        _hulls(view, sums, proposals), _pairs(sums, pieces, odds), _borders(view, graph, scores, sums, kind, proposals),
        _contours(view, sums, kind),
    ]  # fmt: skip
    return np.nan_to_num(np.concatenate(parts, axis=1)).astype(np.float32)


def _kinds(graph: RegionGraph, label: np.ndarray, pieces: ClusterGraph) -> np.ndarray:
    """Return the cluster int (v,) of each vertex; for others `pieces.things` if base, else that plus 1 (artifact)."""
    count, own = pieces.things, label[graph.region]
    return np.where(
        pieces.graph.region < count, pieces.graph.region, count + (own != LABELS.index("base")).astype(int)
    )


def _shapes(view: View, sums: _Sums) -> np.ndarray:
    """Return spread along the principal axes, distribution of normals, and spread of colors."""
    mesh = view.mesh
    points = mesh.points - mesh.points.mean(axis=0)
    center = sums.mean(points)
    products = sums.mean((points[:, :, None] * points[:, None]).reshape(-1, 9)).reshape(-1, 3, 3)
    covariance = products - center[:, :, None] * center[:, None]
    spread = np.sqrt(np.maximum(np.linalg.eigvalsh(covariance), 0.0))
    plan = np.sqrt(np.maximum(np.linalg.eigvalsh(covariance[:, :2, :2]), 0.0))
    normal = sums.mean(mesh.normals)
    outer = sums.mean((mesh.normals[:, :, None] * mesh.normals[:, None]).reshape(-1, 9)).reshape(-1, 3, 3)
    up = mesh.normals[:, 2]
    lab = mesh.lab.astype(np.float64)
    color = np.sqrt(np.maximum(sums.mean(lab**2) - sums.mean(lab) ** 2, 0.0))
    return np.column_stack(
        [spread, spread[:, 0] / (spread[:, 1] + _TINY), spread[:, 1] / (spread[:, 2] + _TINY), plan,
         np.linalg.norm(normal, axis=1), normal[:, 2], np.linalg.eigvalsh(outer)[:, :2], outer[:, 2, 2],
         sums.mean(np.stack([up > 0.8, up < -0.8], axis=1).astype(float)), color]
    )  # fmt: skip


def _boxes(view: View, sums: _Sums, proposals: Proposals) -> np.ndarray:
    low, sides = proposals.low, proposals.high - proposals.low
    faces = sides[:, 0] * sides[:, 1] + sides[:, 1] * sides[:, 2] + sides[:, 0] * sides[:, 2]
    center = sums.mean(view.mesh.points[:, 2:])[:, 0]
    return np.column_stack(
        [low[:, 2], proposals.high[:, 2], sides[:, 2], np.linalg.norm(sides, axis=1),
         sums.area / (2 * faces + 1e-4), sides[:, 2] / (np.linalg.norm(sides[:, :2], axis=1) + 0.01),
         (center - low[:, 2]) / (sides[:, 2] + 0.01)]
    )  # fmt: skip


def _hulls(view: View, sums: _Sums, proposals: Proposals) -> np.ndarray:
    """Return the volume of the convex hull, and ratios of surface, hull and box."""
    count = sums.members.shape[1]
    order = np.argsort(sums.region, kind="stable")
    first = np.searchsorted(sums.region[order], np.arange(count + 1))
    samples = [_spaced(order[a:b], _SAMPLES) for a, b in pairwise(first)]
    pad = _PAD_M * np.array([(1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)])
    found = []
    for start, end in pairwise(sums.members.indptr):
        chosen = _spaced(np.concatenate([samples[k] for k in sums.members.indices[start:end]]), _HULL_SAMPLES)
        try:
            hull = ConvexHull((view.mesh.points[chosen][:, None] + pad).reshape(-1, 3))
            found.append((hull.volume, hull.area))
        except QhullError:
            found.append((1e-7, 1e-4))
    volume, surface = np.array(found).T
    side = np.log(volume + 1e-7) * 2 / 3  # log of an area
    box = np.prod(proposals.high - proposals.low + 2 * _PAD_M, axis=1)
    return np.column_stack(
        [np.log(volume + 1e-7), np.log(sums.area) - side, sums.area / (surface + 1e-4), volume / box,
         np.log(surface + 1e-4) - side]
    )  # fmt: skip


def _spaced(rows: np.ndarray, most: int) -> np.ndarray:
    return rows[np.linspace(0, len(rows) - 1, min(len(rows), most)).astype(int)]


def _row_most(matrix: csr_matrix, values: np.ndarray, lowest: float) -> np.ndarray:
    """Return the maximum of values (n,) over the nonzero columns of each row, `lowest` for empty rows."""
    out = np.full(matrix.shape[0], lowest)
    some = np.diff(matrix.indptr) > 0
    if some.any():
        out[some] = np.maximum.reduceat(values[matrix.indices], matrix.indptr[:-1][some])
    return out


def _pairs(sums: _Sums, pieces: ClusterGraph, odds: np.ndarray) -> np.ndarray:
    """Return statistics of log-odds and features over pairs inside a proposal, and over those with one end inside."""
    members = sums.members
    a, b = pieces.graph.pairs.astype(np.int64).T
    odds = np.clip(odds.astype(np.float64), -CLIP_ODDS, CLIP_ODDS)
    columns = members.tocsc()
    first, second = columns[:, a].tocsr(), columns[:, b].tocsr()
    inside = first.multiply(second).tocsr()
    across = (first + second - 2 * inside).tocsr()
    across.eliminate_zeros()
    inside.eliminate_zeros()
    ins, outs = np.maximum(np.diff(inside.indptr), 1), np.maximum(np.diff(across.indptr), 1)
    near = (pieces.edges[:, PAIR_FEATURES.index("far_gap")] < _NEAR_M).astype(float)
    near_in, near_out = np.maximum(inside @ near, 1), np.maximum(across @ near, 1)
    in_sum, out_sum = inside @ odds, across @ odds
    out = [
        in_sum / ins, np.sign(in_sum) * np.log1p(np.abs(in_sum)), -_row_most(inside, -odds, -CLIP_ODDS),
        (inside @ (odds * near)) / near_in, np.log1p(inside @ np.maximum(-odds, 0)),
        out_sum / outs, np.sign(out_sum) * np.log1p(np.abs(out_sum)), _row_most(across, odds, -8.0),
        (across @ (odds * near)) / near_out, np.log1p(across @ np.maximum(odds, 0)), np.log1p(across @ near),
        *_single_clusters(sums, a, b, odds),
    ]  # fmt: skip
    for name in _BETWEEN:
        values = pieces.edges[:, PAIR_FEATURES.index(name)].astype(np.float64)
        out += [(inside @ values) / ins, (across @ (values * near)) / near_out]
    return np.stack(out, axis=1)


def _single_clusters(sums: _Sums, a: np.ndarray, b: np.ndarray, odds: np.ndarray) -> list[np.ndarray]:
    """Return the largest log-odds of a proposal and one other cluster, and the smallest of a member and the rest."""
    members, shape = sums.members, (sums.members.shape[1],) * 2
    ends = (np.r_[a, b], np.r_[b, a])
    number = (members @ csr_matrix((np.ones(2 * len(a)), ends), shape=shape)).tocoo()  # pyright: ignore[reportAttributeAccessIssue]
    row, other = number.row, number.col
    # Sums of log-odds that cancel out are not stored in the product: look all of them up.
    total = _entries(members @ csr_matrix((np.r_[odds, odds], ends), shape=shape), row, other)
    mean = total / number.data
    own = _entries(members, row, other) > 0
    large = sums.cluster_area[other] > _LARGE * sums.area[row]
    out = []
    for values, chosen, lowest in ((mean, ~own, -8.0), (total, ~own, -20.0), (mean, ~own & large, -8.0)):
        best = np.full(members.shape[0], lowest)
        np.maximum.at(best, row[chosen], values[chosen])
        out.append(best)
    weakest = np.full(members.shape[0], 8.0)
    np.minimum.at(weakest, row[own], mean[own])
    return [*out, weakest]


def _entries(matrix: csr_matrix, row: np.ndarray, column: np.ndarray) -> np.ndarray:
    """Return the entries (k,) of a sparse matrix at rows and columns (k,), also for k = 0, where SciPy does not."""
    return np.asarray(matrix[row, column]).ravel() if len(row) else np.zeros(0)


class _Outward:
    """Sums over ordered pairs of neighbors whose first is inside a proposal and whose second is outside."""

    def __init__(self, sums: _Sums, first: np.ndarray, second: np.ndarray, values: np.ndarray) -> None:
        count = sums.members.shape[1]
        wide = count + len(_BESIDE)
        keys, row = np.unique(first.astype(np.int64) * wide + second, return_inverse=True)
        one, other = keys // wide, keys % wide
        columns = csr_matrix(
            (sums.members.data, sums.members.indices, sums.members.indptr), (sums.members.shape[0], wide)
        ).tocsc()
        out = columns[:, one].tocsr()
        self.pairs = (out - out.multiply(columns[:, other].tocsr())).tocsr()
        self.values = np.stack([np.bincount(row, v, len(keys)) for v in values.T], axis=1)
        self.kind = np.where(other < count, 0, other - count + 1)

    def __call__(self, kind: str) -> np.ndarray:
        """Return the sums (m, k) towards one kind of `_BESIDE`, or towards "all"."""
        chosen = np.flatnonzero((self.kind == _BESIDE.index(kind)) if kind != "all" else self.kind >= 0)
        return self.pairs[:, chosen] @ self.values[chosen]


def _borders(
    view: View, graph: RegionGraph, scores: Scores, sums: _Sums, kind: np.ndarray, proposals: Proposals
) -> np.ndarray:
    """Return length, relative height and mean log-odds of each proposal's border, by kind of the other side."""
    ends, height = kind[graph.links], view.mesh.points[graph.links, 2].mean(axis=1)
    odds = np.clip(scores.affinity[graph.link_pair].astype(np.float64), -_CLIP_BORDER, _CLIP_BORDER)
    values = np.stack([np.ones(len(ends)), height, odds], axis=1)
    first, second, values = (
        np.r_[ends[:, 0], ends[:, 1]], np.r_[ends[:, 1], ends[:, 0]], np.r_[values, values]
    )  # fmt: skip
    across = (first != second) & (first < sums.members.shape[1])
    outward = _Outward(sums, first[across], second[across], values[across])
    tall = proposals.high[:, 2] - proposals.low[:, 2] + 0.01
    out = []
    for name in (*_BESIDE[:3], "all"):
        links, heights, total = outward(name).T
        some, number = links > 0, np.maximum(links, 1)
        out += [
            links * view.mesh.spacing_m / np.sqrt(sums.area),
            np.where(some, (heights / number - proposals.low[:, 2]) / tall, -0.5),
            np.where(some, total / number, 0.0),
        ]
    return np.stack(out, axis=1)


def _contours(view: View, sums: _Sums, kind: np.ndarray) -> np.ndarray:
    """Return the evidence along the image contours of each proposal, and its size in the keyframes."""
    count = sums.members.shape[1]
    nothing = count + len(_BESIDE) - 2
    first, second, values, pixels, rims = [], [], [], [], []
    for frame in view.frames:
        ids = np.where(frame.vertex >= 0, kind[np.maximum(frame.vertex, 0)], nothing)
        depth = np.where(frame.vertex >= 0, frame.drawn[::2, ::2], np.inf).astype(np.float64)
        lab = frame.lab[::2, ::2]
        pixels.append(np.bincount(ids.ravel(), minlength=nothing + 1)[:count])
        rim = np.r_[ids[0], ids[-1], ids[1:-1, 0], ids[1:-1, -1]]
        rims.append(np.bincount(rim, minlength=nothing + 1)[:count])
        for axis in (0, 1):
            a, b = (np.delete(ids, k, axis).ravel() for k in (-1, 0))
            row = np.flatnonzero(a != b)
            before, after = (np.delete(depth, k, axis).ravel()[row] for k in (-1, 0))
            colors = [np.delete(lab, k, axis).reshape(-1, 3)[row] for k in (-1, 0)]
            color = np.minimum(np.linalg.norm(colors[0] - colors[1], axis=1), _CLIP_COLOR)
            odds = np.zeros(len(row))
            if frame.affinity is not None:
                said = np.delete(frame.affinity[3 - axis], -1, axis).ravel()[row].astype(np.float64)
                odds = np.log((said + 1) / (256 - said))
            for one, other, near, far in ((a, b, before, after), (b, a, after, before)):
                own = one[row] < count
                first.append(one[row][own])
                second.append(other[row][own])
                values.append(_contour_values(near[own], far[own], color[own], odds[own]))
    outward = _Outward(sums, np.concatenate(first), np.concatenate(second), np.concatenate(values))
    every = outward("all")
    total = np.maximum(every[:, 0], 1)
    out = [_contour_shares(every, total)]
    for name in _BESIDE:
        found = outward(name)
        out += [found[:, :1] / total[:, None], _contour_shares(found, total)[:, :5]]
    shown, rim = sums.members @ np.stack(pixels, axis=1), sums.members @ np.stack(rims, axis=1)
    best = shown.argmax(axis=1)[:, None]
    most, rim_best = (np.take_along_axis(x, best, axis=1)[:, 0] for x in (shown, rim))
    out.append(
        np.column_stack(
            [np.log1p(most), np.log1p(shown.mean(axis=1)), (shown > _SHOWN_PX).mean(axis=1),
             rim_best / np.sqrt(most + 1), rim.sum(axis=1) / total,
             total / np.maximum(np.sqrt(shown).sum(axis=1), 1)]
        )
    )  # fmt: skip
    return np.concatenate(out, axis=1)


def _contour_values(near: np.ndarray, far: np.ndarray, color: np.ndarray, odds: np.ndarray) -> np.ndarray:
    """Return (k, 8): 1, then terms whose sums give `_CONTOUR`; `far` is inf where no surface was rendered."""
    away = np.where(np.isinf(far), 1.0, far / np.maximum(near, 0.05) - 1.0)
    level = (np.abs(away) <= _LEVEL).astype(float)
    return np.stack(
        [np.ones(len(near)), away > _LEVEL, away < -_LEVEL, level, level * color, level * odds, color, odds],
        axis=1,
    )


def _contour_shares(found: np.ndarray, total: np.ndarray) -> np.ndarray:
    level = np.maximum(found[:, 3], 1)
    return np.column_stack(
        [found[:, 1:4] / total[:, None], found[:, 4:6] / level[:, None], found[:, 6:] / total[:, None]]
    )
