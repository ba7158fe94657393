"""Which true objects were found: boxes matched one to one, and one record an object for breakdowns."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from reconstruction.core.types import Instance, InstanceSet, Surface
from reconstruction.measure.alignment import Alignment
from reconstruction.measure.ground_truth import GroundTruth, TrueEntity
from reconstruction.measure.matching import box_iou, match
from reconstruction.measure.object_facts import ObjectFacts, object_facts

IOU_BOUNDS = (0.25, 0.5)
_TRIMMED_PERCENT = 1.0
_OUTLINED_SHARE = 0.6  # of the box on the wall; with less surface it is that of an outline


@dataclass(frozen=True)
class BoxMatch:
    """True and found boxes, matched one to one at each of IOU_BOUNDS."""

    iou: np.ndarray  # float64 (true, found)
    pairs: dict[float, dict[int, int]]  # bound -> row of a true object -> column of a found one

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
        """Return the IoU of a true object with its match, or with the nearest box where it was missed."""
        column = self.pairs[IOU_BOUNDS[0]].get(row)
        return float(self.iou[row].max(initial=0.0) if column is None else self.iou[row, column])


def match_boxes(wanted: Sequence[TrueEntity], boxes: np.ndarray) -> BoxMatch:
    """Match true objects with found boxes (m, 2, 3), axis-aligned in the true world."""
    iou = box_iou(np.array([e.mesh.bounds for e in wanted]), boxes)
    return BoxMatch(iou, {bound: dict(match(iou, bound)) for bound in IOU_BOUNDS})


def object_records(
    wanted: Sequence[TrueEntity], facts: dict[int, ObjectFacts], matched: BoxMatch, found_ids: Sequence[int]
) -> list[dict[str, Any]]:
    """Return one record a true object: what it is, what makes it hard, whether it was found at which IoU.

    `match` is the id of the object that it was matched with at the lower bound; `gap_cm` is None for an object without
    any neighbor.
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
    """Return the boxes (m, 2, 3) of the instances stage in the true world, before any mesh is made of them.

    `vertices` (n, 3) are the surface's, to which `instances` gives ids. A box is the middle 98 % of an object's surface
    along each axis, down to where the stage says that it stands; of what hangs on a wall, from the wall to the front as
    the stage says: a picture is thinner than the noise of its surface.
    """
    vertices = np.asarray(vertices, np.float64)
    boxes = np.zeros((len(instances.objects), 2, 3))
    for row, item in enumerate(instances.objects):
        own = vertices[instances.vertex_instance == item.id]
        if _is_outline(own, item):
            own = _corners(item)
        own = alignment.to_true(_from_wall_to_front(own, item) if item.attached_hint else own)
        boxes[row] = np.percentile(own, [_TRIMMED_PERCENT, 100 - _TRIMMED_PERCENT], axis=0)
        bottom = item.center - [0.0, 0.0, 0.5 * item.extents_m[2]]
        boxes[row, 0, 2] = min(boxes[row, 0, 2], alignment.to_true(bottom[None])[0, 2])
    return boxes


def _is_outline(points: np.ndarray, item: Instance) -> bool:
    """Tell whether a thing on a wall has hardly any surface (k, 3): its box is that of its masks' outlines."""
    if not item.attached_hint:
        return False
    along = np.array([-np.sin(item.yaw_rad), np.cos(item.yaw_rad), 0.0])
    seen = (
        [np.ptp(points @ axis) for axis in (along, np.array([0.0, 0.0, 1.0]))] if len(points) else [0.0, 0.0]
    )
    return float(np.prod(seen)) < _OUTLINED_SHARE * float(np.prod(item.extents_m[1:]))


def _corners(item: Instance) -> np.ndarray:
    """Return the corners (8, 3) of a thing's box."""
    c, s = np.cos(item.yaw_rad), np.sin(item.yaw_rad)
    signs = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    turned = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return item.center + (signs * item.extents_m) @ turned.T


def _from_wall_to_front(points: np.ndarray, item: Instance) -> np.ndarray:
    """Return points (k, 3) of a thing moved into its box along its wall's normal, and again at the wall: (2k, 3)."""
    normal = np.array([np.cos(item.yaw_rad), np.sin(item.yaw_rad), 0.0])
    half = 0.5 * item.extents_m[0]
    along = (points - item.center) @ normal
    moved = points + (np.clip(along, -half, half) - along)[:, None] * normal
    return np.concatenate([moved, points - (along + half)[:, None] * normal])


def instance_box_figures(
    surface: Surface, instances: InstanceSet, alignment: Alignment, truth: GroundTruth
) -> dict[str, Any]:
    """Return recall and precision of the stage's own boxes, and a record of each evaluated object."""
    matched = match_boxes(truth.evaluated, instance_boxes(surface.vertices, instances, alignment))
    ids = [o.id for o in instances.objects]
    records = object_records(truth.evaluated, object_facts(truth), matched, ids)
    used = set(matched.pairs[IOU_BOUNDS[0]].values())
    extra = [{"id": o.id, "label": o.label} for c, o in enumerate(instances.objects) if c not in used]
    return {**matched.figures(), "found": len(ids), "objects": records, "extra": extra}
