"""Keyframes of rooms in a device's memory: crops for the aggregation network, drawn and disturbed there.

`samples.draw_sample` does the same on a CPU, one crop after the other. A GPU computes thousands of crops a second, more
than processes can draw.
"""

import numpy as np
import torch
from torch.nn import functional

from priors.samples import CROP, JUMP, Room
from reconstruction.depth.aggregation import place_of_depth
from reconstruction.depth.channels import BINS

_REACH_PX = 4  # around steps of depth, as `samples.border_of`
_BLUR_PX = 3  # half width of the blur's kernel


class KeyframePool:
    """All keyframes of the rooms that were added, by picture size (upright and not)."""

    def __init__(self, device: str) -> None:
        """Make an empty pool on a torch device."""
        self._device = torch.device(device)
        self._rooms: set[str] = set()
        self._parts: dict[tuple[int, int], list[dict[str, torch.Tensor]]] = {}

    def __len__(self) -> int:
        """Return the number of keyframes."""
        return sum(len(part["cost"]) for parts in self._parts.values() for part in parts)

    def add(self, rooms: list[Room]) -> None:
        """Copy the rooms that are not there yet."""
        for room in rooms:
            if room.folder.name in self._rooms:
                continue
            self._rooms.add(room.folder.name)
            a = room.arrays
            places, lines = zip(
                *(
                    place_of_depth(np.asarray(depth, np.float64), *ends)
                    for depth, ends in zip(a["true_depth"], a["range"], strict=True)
                ),
                strict=True,
            )
            part = {
                "cost": a["cost"], "smoothed": a["smoothed"], "color": a["color"],
                "place": np.stack(places).astype(np.float32), "ids": a["true_ids"].astype(np.int16),
                "rho": np.array(lines, np.float32),
            }  # fmt: skip
            tensors = {name: torch.from_numpy(np.array(v)).to(self._device) for name, v in part.items()}
            self._parts.setdefault(tuple(a["cost"].shape[1:3]), []).append(tensors)

    def draw(self, count: int, generator: torch.Generator) -> list[torch.Tensor]:
        """Return a batch of crops as `samples.stack` does: correlation, smoothed, color, place, ids, border, rho."""
        crops = [self._crop(generator) for _ in range(count)]
        cost, smoothed, color, place, ids, rho = (torch.stack(column) for column in zip(*crops, strict=True))
        correlation = 1 - cost.permute(0, 3, 1, 2).float() / 127
        smoothed = smoothed.permute(0, 3, 1, 2).float() / 255
        correlation, smoothed, place, rho = self._other_range(correlation, smoothed, place, rho, generator)
        color = self._other_light(color.permute(0, 3, 1, 2).float() / 255, generator)
        return [correlation, smoothed, color, place, ids.int(), border_of(place, rho), rho]

    def _crop(self, generator: torch.Generator) -> tuple[torch.Tensor, ...]:
        row = self._integer(len(self), generator)
        for size, parts in self._parts.items():
            for part in parts:
                if row >= len(part["cost"]):
                    row -= len(part["cost"])
                    continue
                high, wide = min(CROP[0], size[0]), min(CROP[1], size[1])
                y = self._integer(size[0] - high + 1, generator)
                x = self._integer(size[1] - wide + 1, generator)
                names = ("cost", "smoothed", "color", "place", "ids")
                cut = [part[name][row, y : y + high, x : x + wide] for name in names]
                if self._integer(2, generator):
                    cut = [values.flip(1) for values in cut]
                return (*cut, part["rho"][row])
        raise IndexError(row)

    @staticmethod
    def _integer(end: int, generator: torch.Generator) -> int:
        return int(torch.randint(end, (1,), generator=generator))

    def _uniform(self, low: float, high: float, shape: tuple[int, ...], generator) -> torch.Tensor:
        return (low + (high - low) * torch.rand(shape, generator=generator)).to(self._device)

    def _normal(self, spread: float, shape: tuple[int, ...], generator) -> torch.Tensor:
        return (spread * torch.randn(shape, generator=generator)).to(self._device)

    def _other_range(self, correlation, smoothed, place, rho, generator):
        """Sweep another range of depths in seven crops of ten, as `samples._other_range`."""
        n = len(place)
        asked = self._uniform(0, 1, (n,), generator) < 0.7
        step = torch.where(asked, self._uniform(0.75, 1.25, (n,), generator), 1.0)
        first = torch.where(asked, BINS * self._uniform(-0.15, 0.15, (n,), generator), 0.0)
        old = first[:, None] + step[:, None] * torch.arange(BINS, device=self._device)
        rows = old.round().long()
        inside = ((rows >= 0) & (rows < BINS))[..., None, None]
        index = rows.clamp(0, BINS - 1)[..., None, None].expand_as(correlation)
        correlation, smoothed = (torch.gather(v, 1, index) * inside for v in (correlation, smoothed))
        line = (slice(None), None, None)
        moved = torch.where(place >= 0, (place - first[line]) / step[line], -1.0)
        moved = torch.where((moved < 0) | (moved > BINS - 1), -1.0, moved)
        rho = torch.stack([rho[:, 0] + first * rho[:, 1], step * rho[:, 1]], 1)
        return correlation, smoothed, moved, rho

    def _other_light(self, color: torch.Tensor, generator) -> torch.Tensor:
        """Another exposure, contrast and color, as `samples.other_light`."""
        n = len(color)

        def chance(share: float) -> torch.Tensor:
            return (self._uniform(0, 1, (n,), generator) < share)[:, None, None, None]

        order = torch.stack([torch.randperm(3, generator=generator) for _ in range(n)]).to(self._device)
        mixed = torch.gather(color, 1, order[:, :, None, None].expand_as(color))
        color = torch.where(chance(0.3), mixed, color)
        color = torch.where(chance(0.15), color.mean(1, keepdim=True), color)
        gain = (
            self._normal(0.25, (n, 1, 1, 1), generator).exp()
            * self._normal(0.1, (n, 3, 1, 1), generator).exp()
        )
        power = self._normal(0.25, (n, 1, 1, 1), generator).exp()
        color = color.clamp(0, 1) ** power * gain + self._normal(0.04, (n, 1, 1, 1), generator)
        color = torch.where(chance(0.25), self._blurred(color, generator), color)
        noise = torch.randn(color.shape, device=self._device) * self._uniform(
            0, 0.03, (n, 1, 1, 1), generator
        )
        color = torch.where(chance(0.5), color + noise, color)
        return torch.where(chance(0.03), torch.full_like(color, 0.5), color).clamp(0, 1)

    def _blurred(self, color: torch.Tensor, generator) -> torch.Tensor:
        n, channels, h, w = color.shape
        at = torch.arange(-_BLUR_PX, _BLUR_PX + 1, device=self._device)
        kernel = torch.exp(-0.5 * (at / self._uniform(0.4, 1.1, (n, 1), generator)) ** 2)
        kernel = (kernel / kernel.sum(1, keepdim=True)).repeat_interleave(channels, 0)
        flat = functional.pad(color.reshape(1, n * channels, h, w), (_BLUR_PX,) * 4, mode="reflect")
        flat = functional.conv2d(flat, kernel[:, None, :, None], groups=n * channels)
        return functional.conv2d(flat, kernel[:, None, None, :], groups=n * channels).reshape(color.shape)


def border_of(place: torch.Tensor, rho: torch.Tensor) -> torch.Tensor:
    """Return which pixels (b, h, w) lie within a few pixels of a step of the true depth, as `samples.border_of`."""
    values = torch.where(place >= 0, rho[:, 0, None, None] + rho[:, 1, None, None] * place, 0.0)
    step = torch.zeros_like(values)
    for axis in (1, 2):
        length = values.shape[axis] - 1
        a, b = values.narrow(axis, 1, length), values.narrow(axis, 0, length)
        jump = (torch.maximum(a, b) > JUMP * torch.minimum(a, b)).float()
        step.narrow(axis, 1, length).copy_(torch.maximum(step.narrow(axis, 1, length), jump))
        step.narrow(axis, 0, length).copy_(torch.maximum(step.narrow(axis, 0, length), jump))
    return functional.max_pool2d(step[:, None], 2 * _REACH_PX + 1, 1, _REACH_PX)[:, 0] > 0
