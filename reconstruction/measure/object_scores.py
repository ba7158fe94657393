"""Score the objects of a scene against the true ones: detection, complete surface, scene graph."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from reconstruction.measure.ground_truth import GroundTruth, TrueEntity
from reconstruction.measure.matching import IOU_BOUNDS, graph_f1, match_base
from reconstruction.measure.object_boxes import match_boxes, object_records
from reconstruction.measure.object_facts import object_facts
from reconstruction.measure.scene import PlacedMesh
from reconstruction.measure.surfaces import OBJECT_POINTS, compare, sample

OBJECT_BOUND_M = 0.01  # of the F-score, CONTRACT section 4


@dataclass(frozen=True)
class ObjectScores:
    """The result of `score_objects`."""

    metrics: dict[str, float | None]
    records: list[dict[str, Any]]  # one per evaluated true object
    extra: list[dict[str, Any]]  # found objects without a match
    true_of: dict[int, int]  # id of a found object -> id of its true match


def score_objects(found: list[PlacedMesh], truth: GroundTruth, points: int = OBJECT_POINTS) -> ObjectScores:
    """Match found objects, moved to the true world, with the evaluated true ones by boxes; compare their surfaces.

    Surfaces are compared by `points` samples each.
    """
    wanted = list(truth.evaluated)
    matched = match_boxes(wanted, np.array([m.bounds for m in found]))
    pairs = matched.pairs[IOU_BOUNDS[0]]
    records = object_records(wanted, object_facts(truth), matched, [m.id for m in found])
    for row, (entity, record) in enumerate(zip(wanted, records)):
        record.update(_surface_score(entity, found[pairs[row]] if row in pairs else None, points))
    metrics: dict[str, float | None] = dict(matched.figures())
    metrics["object_cd_cm"] = _mean_or_none([r["cd_cm"] for r in records]) or 0.0
    metrics["object_f_1cm"] = float(np.mean([r["f_1cm"] for r in records])) if records else 100.0
    kept = [r for r in records if r["match"] is not None]
    metrics["matched_object_cd_cm"] = _mean_or_none([r["cd_cm"] for r in kept])
    metrics["matched_object_f_1cm"] = _mean_or_none([r["f_1cm"] for r in kept])
    used = set(pairs.values())
    extra = [{"id": m.id, "label": m.label} for c, m in enumerate(found) if c not in used]
    return ObjectScores(metrics, records, extra, {found[c].id: wanted[r].id for r, c in pairs.items()})


def _mean_or_none(values: list[float]) -> float | None:
    return float(np.mean(values)) if values else None


def _surface_score(entity: TrueEntity, found: PlacedMesh | None, points: int) -> dict[str, Any]:
    """Compare complete surfaces; a miss gets the object's diagonal as Chamfer distance and 0 as F-score."""
    diagonal = float(np.linalg.norm(entity.bounds[1] - entity.bounds[0]))
    miss = {"cd_cm": 100 * diagonal, "f_1cm": 0.0}
    if found is None:
        return miss
    out = {"found_label": found.label}
    true = sample(entity.mesh.vertices, entity.mesh.faces, points)
    score = compare(sample(found.vertices, found.faces, points), true, OBJECT_BOUND_M)
    if score is None:
        return out | miss
    center = found.bounds.mean(axis=0) - entity.bounds.mean(axis=0)
    error_cm = float(100 * np.linalg.norm(center))
    return out | {"cd_cm": score.cd_cm, "f_1cm": score.f, "center_error_cm": error_cm}


def score_graph(
    edges: list[dict[str, Any]],
    base: list[PlacedMesh],
    truth: GroundTruth,
    true_of: dict[int, int],
    records: list[dict[str, Any]],
) -> dict[str, float]:
    """Return the F1 score of the scene graph over all evaluated objects and over matched children only.

    Also sets `relation_right` in the record of each matched object with an edge.
    """
    base_of = match_base(base, truth.base)

    def name(item: int) -> tuple[str, int]:
        if item in base_of:
            return "true", base_of[item]
        return ("true", true_of[item]) if item in true_of else ("found", item)

    estimated = {(name(e["child"]), e["relation"], name(e["parent"])) for e in edges}
    true = {(("true", e.id), e.relation, ("true", e.parent)) for e in truth.evaluated}
    edge_of = {e[0]: e for e in estimated}
    for record in records:
        child = ("true", record["true_id"])
        if child in edge_of:
            record["relation_right"] = edge_of[child] in true
    matched = {("true", i) for i in true_of.values()}
    of_matched = [{e for e in side if e[0] in matched} for side in (estimated, true)]
    return {"graph_f1": graph_f1(estimated, true), "graph_f1_matched": graph_f1(*of_matched)}
