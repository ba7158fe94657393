"""Match true objects with estimated bounding boxes; return recall, precision and one record per object."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from reconstruction.core.types import Instance, InstanceSet, Surface
from reconstruction.measure.alignment import Alignment
from reconstruction.measure.ground_truth import GroundTruth, TrueEntity
from reconstruction.measure.matching import IOU_BOUNDS, box_iou, match
from reconstruction.measure.object_facts import ObjectFacts, object_facts

_TRIMMED_PERCENT = 1.0  # of an object's vertices, removed at both ends of each axis
_OUTLINED_SHARE = (
    0.6  # a wall-mounted object whose surface covers less of its box on the wall is taken by the box
)


@dataclass(frozen=True)
class BoxMatch:
    """True and estimated boxes, matched one to one at each of IOU_BOUNDS."""

    iou: np.ndarray  # float64 (true, estimated)
    pairs: dict[float, dict[int, int]]  # bound -> row of a true object -> column of an estimated one

    def figures(self) -> dict[str, float]:
        """Return `object_recall_25`, `object_precision_25` and the same at 50."""
        rows, columns = self.iou.shape
        out: dict[str, float] = {}
        for bound, pairs in self.pairs.items():
            name = f"{round(100 * bound)}"
            out[f"object_recall_{name}"] = len(pairs) / rows if rows else 1.0
            out[f"object_precision_{name}"] = len(pairs) / columns if columns else float(not rows)
        return out

    def box_iou(self, row: int) -> float:
        """Return the IoU of a true object with its match, or the highest IoU if it was missed."""
        column = self.pairs[IOU_BOUNDS[0]].get(row)
        return float(self.iou[row].max(initial=0.0) if column is None else self.iou[row, column])


def match_boxes(wanted: Sequence[TrueEntity], boxes: np.ndarray) -> BoxMatch:
    """Match true objects with estimated boxes (m, 2, 3), axis-aligned in the true world."""
    iou = box_iou(np.array([e.bounds for e in wanted]), boxes)
    return BoxMatch(iou, {bound: dict(match(iou, bound)) for bound in IOU_BOUNDS})


def object_records(
    wanted: Sequence[TrueEntity], facts: dict[int, ObjectFacts], matched: BoxMatch, found_ids: Sequence[int]
) -> list[dict[str, Any]]:
    """Return one record per true object: identity, facts for breakdowns, match and IoU.

    `match` is the id of the object matched at the lower bound; `gap_cm` is None without a neighbor.
    """
    out = []
    for row, entity in enumerate(wanted):
        fact, column = facts[entity.id], matched.pairs[IOU_BOUNDS[0]].get(row)
        out.append(
            {
                "true_id": entity.id,
                "name": entity.name,
                "label": entity.label,
                "visible_pixels": entity.visible_pixels,
                "longest_side_cm": 100 * fact.longest_side_m,
                "support": fact.support,
                "gap_cm": None if fact.neighbor is None else 100 * fact.gap_m,
                "neighbor": fact.neighbor,
                "match": None if column is None else found_ids[column],
                "box_iou": matched.box_iou(row),
                **{f"found_{round(100 * bound)}": row in pairs for bound, pairs in matched.pairs.items()},
            }
        )
    return out


def instance_boxes(vertices: np.ndarray, instances: InstanceSet, alignment: Alignment) -> np.ndarray:
    """Compute axis-aligned boxes (m, 2, 3) in the true world of the objects of the instances stage.

    A box spans the 1st to 99th percentile of the object's vertices along each axis, extended down to its estimated
    bottom. Wall-mounted objects are clamped to their estimated depth range, as they are thinner than surface noise.

    Args:
        vertices: (n, 3) of the fused surface, estimated world.
        instances: ids per vertex.
        alignment: to the true world.
    """
    vertices = np.asarray(vertices, np.float64)
    boxes = np.zeros((len(instances.objects), 2, 3))
    for row, item in enumerate(instances.objects):
        own = vertices[instances.vertex_instance == item.id]
        if _has_little_surface(own, item):
            own = _corners(item)
        own = alignment.to_true(_clamped_to_depth(own, item) if item.attached_hint else own)
        boxes[row] = np.percentile(own, [_TRIMMED_PERCENT, 100 - _TRIMMED_PERCENT], axis=0)
        bottom = item.center - [0.0, 0.0, 0.5 * item.extents_m[2]]
        boxes[row, 0, 2] = min(boxes[row, 0, 2], alignment.to_true(bottom[None])[0, 2])
    return boxes


def _has_little_surface(points: np.ndarray, item: Instance) -> bool:
    """Return whether the surface (k, 3) of a wall-mounted object covers little of its box, which masks gave."""
    if not item.attached_hint:
        return False
    along = np.array([-np.sin(item.yaw_rad), np.cos(item.yaw_rad), 0.0])
    area = float(np.ptp(points @ along) * np.ptp(points @ np.array([0.0, 0.0, 1.0]))) if len(points) else 0.0
    return area < _OUTLINED_SHARE * float(np.prod(item.extents_m[1:]))


def _corners(item: Instance) -> np.ndarray:
    """Return the corners (8, 3) of an instance's oriented box."""
    c, s = np.cos(item.yaw_rad), np.sin(item.yaw_rad)
    signs = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    turned = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return item.center + (signs * item.extents_m) @ turned.T


def _clamped_to_depth(points: np.ndarray, item: Instance) -> np.ndarray:
    """Clamp points (k, 3) to the instance's box along the wall's normal; add their projections to the wall: (2k, 3)."""
    normal = np.array([np.cos(item.yaw_rad), np.sin(item.yaw_rad), 0.0])
    half = 0.5 * item.extents_m[0]
    along = (points - item.center) @ normal
    moved = points + (np.clip(along, -half, half) - along)[:, None] * normal
    return np.concatenate([moved, points - (along + half)[:, None] * normal])


def instance_box_figures(
    surface: Surface, instances: InstanceSet, alignment: Alignment, truth: GroundTruth
) -> dict[str, Any]:
    """Score the boxes of the instances stage: recall, precision, and a record per evaluated object."""
    matched = match_boxes(truth.evaluated, instance_boxes(surface.vertices, instances, alignment))
    ids = [o.id for o in instances.objects]
    records = object_records(truth.evaluated, object_facts(truth), matched, ids)
    used = set(matched.pairs[IOU_BOUNDS[0]].values())
    extra = [{"id": o.id, "label": o.label} for c, o in enumerate(instances.objects) if c not in used]
    return {**matched.figures(), "found": len(ids), "objects": records, "extra": extra}
