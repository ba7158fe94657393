"""How well a cut of a surface finds the true things: area-weighted IoU of vertex sets, matched one to one."""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

LEAST_SHARE = 2000 / (640 * 480)  # of some keyframe: smaller things are not asked for


@dataclass(frozen=True)
class Figures:
    """Counts over one or more rooms; add them up."""

    true: int  # things asked for
    found: int  # predicted things, without those that are mostly on true things that are not asked for
    hits: tuple[int, int]  # matched at IoU .25 and .5

    def __add__(self, other: "Figures") -> "Figures":
        """Return the counts of both."""
        hits = (self.hits[0] + other.hits[0], self.hits[1] + other.hits[1])
        return Figures(self.true + other.true, self.found + other.found, hits)

    def shares(self) -> dict[str, float]:
        """Return recall and precision at .25, and recall at .5."""
        true, found = max(self.true, 1), max(self.found, 1)
        return {
            "recall_25": self.hits[0] / true, "precision_25": self.hits[0] / found, "recall_50": self.hits[1] / true,
        }  # fmt: skip


NOTHING = Figures(0, 0, (0, 0))


def compare(
    predicted: np.ndarray, true: np.ndarray, base_entities: int, areas: np.ndarray, pixels: np.ndarray
) -> tuple[Figures, dict[int, float]]:
    """Measure one room.

    Args:
        predicted: int (v,) thing at each vertex, 0 = none.
        true: int (v,) entity at each vertex, 0 = unknown; ids up to `base_entities` are no things.
        base_entities: how many.
        areas: float (v,) m2.
        pixels: float (ids,) greatest share of a keyframe that shows each entity.

    Returns:
        Counts, and the IoU of each thing that is asked for with the predicted thing it was matched to (0: none).
    """
    names = np.unique(predicted[predicted > 0])
    ids = np.arange(len(pixels))
    asked = ids[(ids > base_entities) & (pixels >= LEAST_SHARE)]
    table = np.zeros((int(predicted.max(initial=0)) + 1, len(pixels)))
    np.add.at(table, (predicted, true), areas)
    table = table[names] if len(names) else np.zeros((0, len(pixels)))
    whole = np.bincount(true, weights=areas, minlength=len(pixels))
    union = table.sum(axis=1)[:, None] + whole[None, asked] - table[:, asked]
    iou = table[:, asked] / np.maximum(union, 1e-12)
    rows, columns = linear_sum_assignment(-iou)
    matched = dict.fromkeys(asked.tolist(), 0.0)
    matched.update({int(asked[c]): float(iou[r, c]) for r, c in zip(rows, columns)})
    small = np.setdiff1d(ids[ids > base_entities], asked)
    excused = table[:, small].sum(axis=1) > 0.5 * table.sum(axis=1)
    hit = {int(r) for r, c in zip(rows, columns) if iou[r, c] >= 0.25}
    found = sum(1 for r in range(len(names)) if not excused[r] or r in hit)
    values = np.array(list(matched.values()))
    return Figures(len(asked), found, (int((values >= 0.25).sum()), int((values >= 0.5).sum()))), matched
