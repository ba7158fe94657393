"""Figures of the learned cut on whole rooms."""

import numpy as np
from scipy.sparse import csr_array
from scipy.stats import rankdata

from priors.partition_clusters import RoomProposals
from priors.partition_rooms import Example
from priors.partition_ruler import NOTHING, compare
from priors.partition_targets import Targets
from reconstruction.instances import InstancesConfig
from reconstruction.instances.partition.choice import best_disjoint, likeliest_things
from reconstruction.instances.partition.cut import clusters_of_things
from reconstruction.instances.partition.graph import LABELS, Scores
from reconstruction.instances.partition.model import Ensemble
from reconstruction.instances.partition.multicut import partition_with_labels

_HITS = (0.25, 0.5)


def figures_of(model: Ensemble, rooms: list[Example]) -> dict[str, float]:
    """Return figures by name: of superpoints, affinities, labels, and of things after the partition."""
    scores = [model.scores(room.nodes, room.edges, room.pairs) for room in rooms]
    out = affinity_figures(rooms, scores) | superpoint_figures(rooms)
    found = [partitioned(room, score) for room, score in zip(rooms, scores)]
    out |= things_figures(rooms, found)
    best = things_figures(rooms, [by_truth(room) for room in rooms])
    return out | {f"by_truth_{name}": value for name, value in best.items()}


def partitioned(room: Example, scores: Scores) -> np.ndarray:
    """Return the thing int (v,) of each vertex by the partition, 0 = none."""
    label, cluster = partition_with_labels(room.pairs, scores.affinity, scores.label)
    label, cluster = label[room.region], cluster[room.region]
    chosen = clusters_of_things(room.areas, label, cluster, InstancesConfig())
    number = np.zeros(int(cluster.max()) + 1, np.int64)
    number[chosen] = 1 + np.arange(len(chosen))
    return number[cluster]


def proposal_figures(
    rooms: list[RoomProposals], said: list[np.ndarray], twice: list[csr_array] | None = None
) -> dict[str, float]:
    """Return figures of the things chosen from proposals by their estimated IoU, and of the best choice there is.

    Args:
        rooms: proposals with truth.
        said: float (m,) estimated IoU of each room's proposals.
        twice: float (m, m) what pairs of them count twice; None: nothing.
    """
    costs = twice or [None] * len(rooms)
    out = things_figures(
        [r.example for r in rooms],
        [chosen(r, likeliest_things(r.members, iou, cost)) for r, iou, cost in zip(rooms, said, costs)],
    )
    best = things_figures(
        [r.example for r in rooms], [chosen(r, best_disjoint(r.members, _worth(r.best_iou))) for r in rooms]
    )
    error = np.concatenate([iou - room.best_iou for room, iou in zip(rooms, said)])
    out |= {f"by_truth_{name}": value for name, value in best.items()}
    return out | {"iou_error": round(float(np.sqrt(np.mean(error**2))), 4)}


def _worth(iou: np.ndarray) -> np.ndarray:
    return np.where(iou >= _HITS[0], 1.0 + (iou >= _HITS[1]) + 0.01 * iou, 0.0)


def chosen(room: RoomProposals, rows: np.ndarray) -> np.ndarray:
    """Return the thing int (v,) of each vertex by rows of proposals, 0 = none or too small."""
    members = room.members[rows]
    number = np.zeros(room.members.shape[1] + 1, np.int64)
    number[members.indices] = 1 + np.repeat(np.arange(members.shape[0]), np.diff(members.indptr))
    thing = number[np.minimum(room.region, room.members.shape[1])]
    area = np.bincount(thing, weights=room.example.areas)
    config = InstancesConfig()
    kept = (area >= config.min_object_area_m2) & (np.bincount(thing) >= config.min_object_vertices)
    return np.where(kept[thing], thing, 0)


def by_truth(room: Example) -> np.ndarray:
    """Return the thing of each vertex that the best choice for its superpoint would give."""
    ids = room.region_ids()[0][room.region]
    return np.where(ids > room.base_entities, ids, 0)


def things_figures(rooms: list[Example], found: list[np.ndarray]) -> dict[str, float]:
    """Return recall and precision over all rooms."""
    total = NOTHING
    for room, predicted in zip(rooms, found):
        total += compare(predicted, room.true_ids, int(room.base_entities), room.areas, room.pixels)[0]
    return {name: round(value, 3) for name, value in total.shares().items()} | {"things": total.true}


def superpoint_figures(rooms: list[Example]) -> dict[str, float]:
    """Return the achievable segmentation accuracy: the share of surface whose superpoint's majority is its entity."""
    right, whole, right_things, things = np.zeros(4)
    for room in rooms:
        ids = room.region_ids()[0][room.region]
        known, thing = room.true_ids > 0, room.true_ids > room.base_entities
        right += room.areas[known & (ids == room.true_ids)].sum()
        whole += room.areas[known].sum()
        right_things += room.areas[thing & (ids == room.true_ids)].sum()
        things += room.areas[thing].sum()
    return {
        "asa": round(right / max(whole, 1e-9), 4),
        "asa_things": round(right_things / max(things, 1e-9), 4),
    }


def affinity_figures(rooms: list[Example], scores: list[Scores]) -> dict[str, float]:
    """Return area under the curve and log loss of affinities, and the accuracy of labels by area."""
    targets = [Targets.of(room) for room in rooms]
    said = np.concatenate([s.affinity for s in scores]).astype(np.float64)
    same = np.concatenate([t.same for t in targets])
    weight = np.concatenate([t.same_weight for t in targets])
    log_loss = np.logaddexp(0, np.where(same > 0, -said, said))
    kept = weight > 0
    out = {
        "auc": round(area_under_curve(said[kept], same[kept] > 0), 4),
        "log_loss": round(float(np.average(log_loss, weights=weight)), 4),
        "cut_share": round(float(np.average(same == 0, weights=weight)), 4),
    }
    for k, name in enumerate(LABELS):
        true = np.concatenate([t.label for t in targets]) == k
        found = np.concatenate([s.label.argmax(axis=1) for s in scores]) == k
        area = np.concatenate([np.bincount(r.region, weights=r.areas, minlength=len(r.nodes)) for r in rooms])
        out[f"iou_{name}"] = round(float(area[true & found].sum() / max(area[true | found].sum(), 1e-9)), 3)
    return out


def area_under_curve(scores: np.ndarray, positive: np.ndarray) -> float:
    """Return the area under the receiver operating characteristic."""
    ranks, count = rankdata(scores), positive.sum()
    pairs = max(count * (len(scores) - count), 1)
    return float((ranks[positive].sum() - count * (count + 1) / 2) / pairs)
