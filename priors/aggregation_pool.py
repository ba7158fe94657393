"""Crops for the aggregation network, drawn and disturbed on a device."""

import numpy as np
import torch

from priors.keyframe_pool import KeyframePool, near_steps
from priors.samples import CROP, Room
from reconstruction.depth.aggregation import place_of_depth
from reconstruction.depth.channels import BINS

_REACH_PX = 4  # around steps of depth, as `samples.border_of`


class AggregationPool(KeyframePool):
    """Costs, pictures and truth of keyframes."""

    crop = CROP

    def arrays_of(self, room: Room) -> tuple[tuple[int, int], dict[str, np.ndarray]]:
        """Return the arrays of a room, with the true depth as a place in bins."""
        a = room.arrays
        ends = zip(a["true_depth"], a["range"], strict=True)
        places, lines = zip(*(place_of_depth(np.asarray(d, np.float64), *r) for d, r in ends), strict=True)
        return tuple(a["cost"].shape[1:3]), {
            "cost": a["cost"], "smoothed": a["smoothed"], "color": a["color"],
            "place": np.stack(places).astype(np.float32), "ids": a["true_ids"].astype(np.int16),
            "rho": np.array(lines, np.float32),
        }  # fmt: skip

    def draw(self, count: int, generator: torch.Generator) -> list[torch.Tensor]:
        """Return a batch of crops as `samples.stack` does: correlation, smoothed, color, place, ids, border, rho."""
        part, at = self.choose(count, generator)
        cost, smoothed, color, place, ids = (
            self.nearest(part[name], at) for name in ("cost", "smoothed", "color", "place", "ids")
        )
        rho = part["rho"][at.keyframes[:, 0, 0]]
        correlation, smoothed, place, rho = self._other_range(cost, smoothed, place, rho, generator)
        color = self.other_light(color.permute(0, 3, 1, 2).float() / 255, generator)
        return [correlation, smoothed, color, place, ids.int(), border_of(place, rho), rho]

    def _other_range(self, cost, smoothed, place, rho, generator):
        """Sweep another range of depths in seven crops of ten, as `samples._other_range`."""
        n = len(place)
        asked = self.uniform(0, 1, (n,), generator) < 0.7
        step = torch.where(asked, self.uniform(0.75, 1.25, (n,), generator), 1.0)
        first = torch.where(asked, BINS * self.uniform(-0.15, 0.15, (n,), generator), 0.0)
        rows = (first[:, None] + step[:, None] * torch.arange(BINS, device=self.device)).round().long()
        outside = ((rows < 0) | (rows >= BINS))[:, None, None]
        index = rows.clamp(0, BINS - 1)[:, None, None].expand_as(cost)
        line = (slice(None), None, None)
        # Bytes are moved before they become numbers; a cost of 127 is a correlation of 0.
        cost = torch.gather(cost, 3, index).masked_fill(outside, 127)
        smoothed = torch.gather(smoothed, 3, index).masked_fill(outside, 0)
        moved = torch.where(place >= 0, (place - first[line]) / step[line], -1.0)
        moved = torch.where((moved < 0) | (moved > BINS - 1), -1.0, moved)
        rho = torch.stack([rho[:, 0] + first * rho[:, 1], step * rho[:, 1]], 1)
        correlation = 1 - cost.permute(0, 3, 1, 2).float() / 127
        return correlation, smoothed.permute(0, 3, 1, 2).float() / 255, moved, rho


def border_of(place: torch.Tensor, rho: torch.Tensor) -> torch.Tensor:
    """Return which pixels (b, h, w) lie within a few pixels of a step of the true depth, as `samples.border_of`."""
    values = torch.where(place >= 0, rho[:, 0, None, None] + rho[:, 1, None, None] * place, 0.0)
    return near_steps(values, _REACH_PX)
