"""Duplicate proposals: pairs of disjoint proposals in, out the estimated IoU that a choice of both counts twice.

Each proposal is estimated by itself. Two halves of one object have an IoU of .5 with it each; a choice of both would
count 1, though only one of them can be matched with the object. Boosted trees estimate the smaller IoU of the two
where both belong to one object, and 0 where they do not.
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array, csr_array, csr_matrix
from scipy.special import expit

from reconstruction.instances.partition.boosting import Boosted
from reconstruction.instances.partition.choice import LEAST_COST
from reconstruction.instances.partition.clusters import CLIP_ODDS
from reconstruction.instances.partition.proposals import Proposals

DUPLICATE_FEATURES = (
    "iou", "other_iou", "log_area", "area_ratio", "diagonal", "links", "odds_mean", "odds_by_area", "gap", "gap_up",
    "plan_overlap", "height_overlap", "foot_step", "top_step",
)  # fmt: skip
_TINY = 1e-9


@dataclass(frozen=True)
class ProposalPairs:
    """Pairs of disjoint proposals that can both be chosen and have clusters near each other."""

    first: np.ndarray  # int64 (k,) row of the larger proposal
    second: np.ndarray  # int64 (k,)
    rows: np.ndarray  # float32 (k, len(DUPLICATE_FEATURES))
    count: int  # number m of proposals

    def counted_twice(self, trees: Boosted) -> csr_array:
        """Return the IoU that each pair counts twice as the trees estimate it, float (m, m), symmetric."""
        value = expit(trees(self.rows).astype(np.float64))
        ends = np.concatenate([self.first, self.second]), np.concatenate([self.second, self.first])
        return coo_array((np.tile(value, 2), ends), (self.count, self.count)).tocsr()


def proposal_pairs(
    proposals: Proposals, iou: np.ndarray, area: np.ndarray, links: np.ndarray, odds: np.ndarray
) -> ProposalPairs:
    """Return the pairs of proposals that may be pieces of one object, with features.

    Args:
        proposals: m sets of clusters.
        iou: float (m,) estimated IoU of each and its best object.
        area: float (n,) of each cluster, square metres.
        links: int (e, 2) pairs of clusters that may be pieces of one object.
        odds: float (e,) log-odds that they are.
    """
    likely = np.flatnonzero(iou > LEAST_COST)
    members, own_area = proposals.members[likely], proposals.members[likely] @ area
    own = np.minimum(area[links[:, 0]], area[links[:, 1]])
    odds = np.clip(odds.astype(np.float64), -CLIP_ODDS, CLIP_ODDS)
    number, total, weight, weighted = (
        _between(members, links, values) for values in (np.ones(len(odds)), odds, own, own * odds)
    )
    a, b = np.nonzero(np.triu((number > 0) & ~((members @ members.T).toarray() > 0), 1))
    a, b = np.where(own_area[a] < own_area[b], (b, a), (a, b))
    low, high = proposals.low[likely], proposals.high[likely]
    size = high - low
    apart = np.maximum(np.maximum(low[a] - high[b], low[b] - high[a]), 0.0)
    shared = np.maximum(np.minimum(high[a], high[b]) - np.maximum(low[a], low[b]), 0.0)
    overlap = shared / np.maximum(np.minimum(size[a], size[b]), _TINY)
    both = np.maximum(high[a], high[b]) - np.minimum(low[a], low[b])
    columns = (
        iou[likely][a], iou[likely][b], np.log(np.maximum(own_area[a], _TINY)),
        own_area[b] / np.maximum(own_area[a], _TINY), np.linalg.norm(both, axis=1), number[a, b],
        total[a, b] / number[a, b], weighted[a, b] / np.maximum(weight[a, b], _TINY), np.linalg.norm(apart, axis=1),
        apart[:, 2], overlap[:, 0] * overlap[:, 1], overlap[:, 2], low[b, 2] - low[a, 2], high[b, 2] - high[a, 2],
    )  # fmt: skip
    return ProposalPairs(likely[a], likely[b], np.column_stack(columns).astype(np.float32), len(iou))


def _between(members: csr_matrix, links: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the sum of the values (e,) of the links between any two proposals, float (m, m)."""
    count = members.shape[1]  # pyright: ignore[reportOptionalSubscript]
    ends = np.concatenate([links[:, 0], links[:, 1]]), np.concatenate([links[:, 1], links[:, 0]])
    table = csr_matrix((np.tile(values, 2), ends), shape=(count, count))
    return (members @ table @ members.T).toarray()
