"""True affinities and labels of a room's graph of superpoints."""

from dataclasses import dataclass

import numpy as np

from priors.partition_rooms import Example
from reconstruction.instances.partition.graph import LABELS

_CRUMB_M2 = 1e-4  # regions below this count less
_LEAST_WEIGHT = 0.05


@dataclass(frozen=True)
class Targets:
    """True affinities and labels of a graph, with weights."""

    same: np.ndarray  # float32 (e,) 1 = both sides are of one thing, or both base, or both artifacts
    same_weight: np.ndarray  # float32 (e,)
    label: np.ndarray  # int64 (n,) row in LABELS
    label_weight: np.ndarray  # float32 (n,)

    @classmethod
    def of(cls, room: Example) -> "Targets":
        """Read the truth off a room."""
        ids, pure = room.region_ids()
        base = (ids > 0) & (ids <= room.base_entities)
        area = np.bincount(room.region, weights=room.areas, minlength=len(ids))
        weight = np.clip(area / _CRUMB_M2, _LEAST_WEIGHT, 1.0) * pure
        a, b = room.pairs[:, 0], room.pairs[:, 1]
        ids = np.where(base, 1, ids)
        label = np.where(ids == 0, LABELS.index("artifact"), np.where(base, LABELS.index("base"), 0))
        return cls(
            (ids[a] == ids[b]).astype(np.float32), np.minimum(weight[a], weight[b]).astype(np.float32),
            label.astype(np.int64), weight.astype(np.float32),
        )  # fmt: skip
