"""Object proposals: clusters and log-odds of pairs in, regions of merge trees out.

A sum of pairwise scores cannot tell a whole object from a part of it. So regions of many sizes are proposed by
hierarchical merging, to be scored as wholes (Arbelaez et al., Multiscale combinatorial grouping, CVPR 2014; Endres and
Hoiem, Category independent object proposals, ECCV 2010).
"""

import heapq
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix

from reconstruction.instances.partition.clusters import CLIP_ODDS, ClusterGraph
from reconstruction.instances.partition.features import View

LARGEST_M = 4.0  # largest diagonal of a proposal's bounding box
LEAST_AREA_M2 = 0.002  # of a proposal
ALIKE = 1.03  # a region is left out if its parent in the merge tree is larger by less than this factor


@dataclass(frozen=True)
class Proposals:
    """Sets of clusters with their bounding boxes."""

    members: csr_matrix  # float64 (m, n) 1 = the cluster is in the proposal
    low: np.ndarray  # float64 (m, 3) metres
    high: np.ndarray  # float64 (m, 3)

    def taken(self, rows: np.ndarray) -> "Proposals":
        """Return some of the proposals."""
        return Proposals(self.members[rows], self.low[rows], self.high[rows])


def propose(view: View, pieces: ClusterGraph, odds: np.ndarray) -> Proposals:
    """Return the regions of two merge trees, with summed and with mean log-odds of pairs as linkage.

    Each region is proposed a second time together with all clusters below it: a pedestal or legs often share no
    measured surface with the top.

    Args:
        view: the surface.
        pieces: its clusters, and pairs of them.
        odds: float (e,) log-odds that both clusters of a pair are one object.
    """
    count, region = pieces.things, pieces.graph.region
    area = np.bincount(region, weights=view.mesh.areas, minlength=count + 1)[:count]
    pairs = pieces.graph.pairs.astype(np.int64)
    odds = np.clip(odds.astype(np.float64), -CLIP_ODDS, CLIP_ODDS)
    found = {frozenset([k]) for k in range(count)}
    for linkage in (total_odds, _mean):
        found |= set(regions_of_tree(area, pairs, odds, linkage))
    inside = region < count
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    np.minimum.at(low, region[inside], view.mesh.points[inside])
    np.maximum.at(high, region[inside], view.mesh.points[inside])
    middle = 0.5 * (low + high)
    found |= {with_all_below(members, low, high, middle) for members in found}
    regions = sorted(sorted(members) for members in found)
    members = members_of(regions, count)
    if not regions:
        return Proposals(members, low, high)
    starts = members.indptr[:-1]
    low = np.minimum.reduceat(low[members.indices], starts, axis=0)
    high = np.maximum.reduceat(high[members.indices], starts, axis=0)
    kept = (np.linalg.norm(high - low, axis=1) < LARGEST_M) & (members @ area >= LEAST_AREA_M2)
    return Proposals(members[kept], low[kept], high[kept])


def with_all_below(
    members: frozenset[int], low: np.ndarray, high: np.ndarray, middle: np.ndarray
) -> frozenset[int]:
    """Return a region with the clusters whose box centers (n, 3) are below its box and inside its footprint."""
    rows = list(members)
    least, most = low[rows].min(axis=0), high[rows].max(axis=0)
    within = ((middle[:, :2] > least[:2]) & (middle[:, :2] < most[:2])).all(axis=1)
    return members | frozenset(np.flatnonzero(within & (middle[:, 2] < least[2])).tolist())


def members_of(regions: list[list[int]], count: int) -> csr_matrix:
    """Return lists of clusters as the rows of a binary matrix (m, count)."""
    starts = np.cumsum([0, *(len(r) for r in regions)])
    every = np.array([k for r in regions for k in r], np.int64)
    return csr_matrix((np.ones(len(every)), every, starts), shape=(len(regions), count))


Link = tuple[float, int]  # sum and number of the pairwise log-odds between two regions


def total_odds(link: Link) -> float:
    """Return the sum of the odds of a link."""
    return link[0]


def _mean(link: Link) -> float:
    return link[0] / link[1]


def regions_of_tree(
    area: np.ndarray, pairs: np.ndarray, odds: np.ndarray, linkage: Callable[[Link], float]
) -> list[frozenset[int]]:
    """Return the regions of one merge tree, without those that are almost as large as their parent; see `ALIKE`.

    A merged region goes on under the number of the side with more links, whose links to others stay as they are.
    """
    around: list[dict[int, Link]] = [{} for _ in area]
    for (a, b), value in zip(pairs.tolist(), odds.tolist()):
        around[a][b] = around[b][a] = (value, 1)
    heap = [(-linkage(link), a, b) for a, links in enumerate(around) for b, link in links.items() if a < b]
    heapq.heapify(heap)
    sides: list[tuple[int, int]] = []  # of each merge; regions are numbered on from the clusters
    region = list(range(len(area)))  # that goes on under a number
    size, since = area.tolist(), area.tolist()  # area of each region, and where its growth is measured from
    dropped = set()
    while heap:
        value, a, b = heapq.heappop(heap)
        if b not in around[a] or -linkage(around[a][b]) != value:
            continue
        kept, gone = (a, b) if len(around[a]) >= len(around[b]) else (b, a)
        for other, (total, number) in around[gone].items():
            del around[other][gone]
            if other != kept:
                before = around[kept].get(other, (0.0, 0))
                link = before[0] + total, before[1] + number
                around[kept][other] = around[other][kept] = link
                heapq.heappush(heap, (-linkage(link), min(kept, other), max(kept, other)))
        around[gone] = {}
        first, second = region[kept], region[gone]
        large = first if size[first] >= size[second] else second
        region[kept] = len(size)
        sides.append((first, second))
        size.append(size[first] + size[second])
        alike = size[-1] < ALIKE * since[large]
        since.append(since[large] if alike else size[-1])
        if alike:
            dropped.add(large)
    merged = range(len(area), len(size))
    return [_clusters_of(k, sides, len(area)) for k in merged if k not in dropped]


def _clusters_of(region: int, sides: list[tuple[int, int]], count: int) -> frozenset[int]:
    """Return the clusters below a region of a merge tree over `count` clusters."""
    out, below = set(), [region]
    while below:
        top = below.pop()
        if top < count:
            out.add(top)
        else:
            below += sides[top - count]
    return frozenset(out)


def distinct(members: csr_matrix, area: np.ndarray, score: np.ndarray, most: int, alike: float) -> np.ndarray:
    """Return the best proposal that each is almost the same as: non-maximum suppression.

    Args:
        members: (m, n) 1 = the cluster is in the proposal.
        area: float (n,) of each cluster.
        score: float (m,) of each proposal.
        most: number of best proposals at the most.
        alike: IoU of two proposals above which the one with the higher score stands for both.

    Returns:
        int (m,) row of the proposal that stands for each, its own for the best ones, -1 for none.
    """
    own, out = np.asarray(members @ area).ravel(), np.full(len(score), -1)
    found = 0
    for row in np.argsort(-score, kind="stable").tolist():
        if found == most:
            break
        if out[row] < 0:
            found += 1
            inside = np.zeros(len(area))
            clusters = members.indices[members.indptr[row] : members.indptr[row + 1]]
            inside[clusters] = area[clusters]
            shared = members @ inside
            out[(out < 0) & (shared > alike * (own + own[row] - shared))] = row
            out[row] = row
    return out
