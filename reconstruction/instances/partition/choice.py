"""Choice of objects: proposals with estimated IoU in, disjoint ones out, by weighted set packing with pairwise terms.

The sum of the estimates counts an object twice where two pieces of it are chosen. `duplicates` estimates for each pair
of proposals the part that is counted twice; it is subtracted (Desai, Ramanan and Fowlkes, Discriminative models for
multi-class object layout, ICCV 2009).
"""

import numpy as np
from scipy.optimize import Bounds, LinearConstraint, milp
from scipy.sparse import csr_array, csr_matrix

LEAST_COST = 0.1  # estimated IoU under which a proposal is no object in any scene
_TIME_S = 20.0  # limit of the integer program; the best solution until then is used
_TINY = 1e-9


def likeliest_things(members: csr_matrix, iou: np.ndarray, twice: csr_array | None = None) -> np.ndarray:
    """Return the rows of the disjoint proposals that are objects: a choice that agrees with its own expected F1.

    If as many objects are there as are chosen, the expected F1 is the mean of the chosen estimates, without what is
    counted twice, and proposals below half of it lower it (Lipton et al., Optimal thresholding of classifiers to
    maximize F1 measure, ECML 2014). So the cost of a proposal rises from `LEAST_COST` to half of that mean. In a scene
    unlike those that models were trained on, whose estimates are lower throughout, it is lower.

    Args:
        members: (m, n) 1 = the cluster is in the proposal.
        iou: float (m,) estimated IoU of each proposal and its best object.
        twice: float (m, m) symmetric, the part of the IoU that is counted twice where both of a pair are chosen; None:
            nothing.
    """
    cost, twice = LEAST_COST, csr_array((len(iou), len(iou))) if twice is None else twice
    while True:
        chosen = best_choice(members, iou - cost, twice)
        total = float(iou[chosen].sum()) - 0.5 * float(twice[chosen][:, chosen].sum())
        half = 0.5 * total / max(len(chosen), 1)
        if half <= cost:
            return chosen
        cost = half


def best_choice(members: csr_matrix, gain: np.ndarray, twice: csr_array) -> np.ndarray:
    """Return the rows of disjoint proposals with a large total gain less what pairs of them count twice.

    The best choice without pairwise terms is improved by local search: a proposal is added in place of those that it
    overlaps, or one is left out, while the total rises.

    Args:
        members: (m, n) 1 = the cluster is in the proposal.
        gain: float (m,) of each proposal; only positive ones are chosen.
        twice: float (m, m) symmetric, of each pair.
    """
    rows = np.flatnonzero(gain > 0)
    own = members[rows]
    overlap = (own @ own.T).toarray() > 0
    gain, cost, chosen = gain[rows], twice[rows][:, rows].toarray(), best_disjoint(own, gain[rows])
    while len(chosen):
        gone, among = overlap[:, chosen].astype(float), cost[np.ix_(chosen, chosen)]
        # of each proposal in place of those that it overlaps, and of each chosen one left out
        added = gain - gone @ gain[chosen] - ((1 - gone) * cost[:, chosen]).sum(1) + gone @ among.sum(1)
        added -= 0.5 * ((gone @ among) * gone).sum(1)
        added[chosen] = 0.0
        left_out = among.sum(1) - gain[chosen]
        if max(added.max(), left_out.max()) < _TINY:
            break
        if left_out.max() > added.max():
            chosen = np.delete(chosen, left_out.argmax())
        else:
            new = added.argmax()
            chosen = np.sort(np.append(chosen[~overlap[new, chosen]], new))
    return rows[chosen]


def best_disjoint(members: csr_matrix, gain: np.ndarray) -> np.ndarray:
    """Return the rows of the disjoint proposals with the largest total gain: weighted set packing by integer program.

    Args:
        members: (m, n) 1 = the cluster is in the proposal.
        gain: float (m,) of each proposal; only positive ones are chosen.
    """
    rows = np.flatnonzero(gain > 0)
    if not len(rows):
        return rows
    once = LinearConstraint(members[rows].T.tocsr(), -np.inf, 1)
    found = milp(
        -gain[rows], constraints=once, bounds=Bounds(0, 1), integrality=np.ones(len(rows)),
        options={"time_limit": _TIME_S},
    )  # fmt: skip
    if found.x is None:  # no solution within the time limit
        return disjoint_by_gain(members, gain, rows)
    return rows[found.x > 0.5]


def disjoint_by_gain(members: csr_matrix, gain: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Choose disjoint rows by falling gain; return their numbers."""
    taken, out = np.zeros(members.shape[1], bool), []  # pyright: ignore[reportOptionalSubscript]
    for row in rows[np.argsort(-gain[rows], kind="stable")].tolist():
        own = members.indices[members.indptr[row] : members.indptr[row + 1]]
        if not taken[own].any():
            taken[own] = True
            out.append(row)
    return np.sort(np.array(out, np.int64))
