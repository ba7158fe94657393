"""Figures of the learned cut and of the cut by rules on whole rooms, by the same ruler."""

from pathlib import Path

import numpy as np
from scipy.stats import rankdata

from priors.partition_rooms import Example, cached, frames_and_depth, fused
from priors.partition_ruler import NOTHING, compare
from priors.samples import Room
from reconstruction.instances import InstancesConfig, find_instances
from reconstruction.instances.partition.cut import clusters_of_things
from reconstruction.instances.partition.graph import LABELS, Scores
from reconstruction.instances.partition.model import Ensemble
from reconstruction.instances.partition.multicut import partition_with_labels
from reconstruction.progress import NO_PROGRESS

_SHIFTS = tuple(0.25 * k for k in range(-10, 9))  # log-odds


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


def best_shift(model: Ensemble, rooms: list[Example]) -> float:
    """Return the bias of the affinities' log-odds under which the cut of whole rooms is best, on rooms trained on.

    Scores of neighboring borders hang together, which a sum of log-odds does not know: probabilities that are right for
    single borders are not the best weights of a multicut. Best is the mean of F1 at .25 and recall at .5.
    """
    scores = [model.scores(room.nodes, room.edges, room.pairs) for room in rooms]

    def merit(shift: float) -> float:
        found = [partitioned(room, Scores(s.affinity + shift, s.label)) for room, s in zip(rooms, scores)]
        figures = things_figures(rooms, found)
        recall, precision = figures["recall_25"], figures["precision_25"]
        return 2 * recall * precision / max(recall + precision, 1e-9) + figures["recall_50"]

    return max(_SHIFTS, key=merit)


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


def rules_figures(rooms: list[Room], examples: list[Example], cache: Path) -> dict[str, float]:
    """Return the same figures for the cut by rules, with default settings; its results are cached by room."""
    found = []
    for room in rooms:
        file = cached(room, cache, "rules").with_suffix(".npy")
        if not file.is_file():
            posed, depth = frames_and_depth(room, cache)
            config = InstancesConfig(cut="rules")
            instances = find_instances(posed, depth, fused(room, cache), config, progress=NO_PROGRESS)
            ids = instances.vertex_instance
            file.parent.mkdir(parents=True, exist_ok=True)
            np.save(file, np.where(ids > len(instances.base), ids, 0))
        found.append(np.load(file))
    return things_figures(examples, found)


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
    from priors.partition import Targets

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
