"""Keyframes of rooms in a device's memory: crops are drawn, resized and disturbed there, a batch at a time.

The `draw_sample` functions do the same on a CPU, one crop after the other. A GPU computes thousands of crops a second,
more than processes can draw.
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch.nn import functional

from priors.samples import JUMP, Room

_BLUR_PX = 3  # half width of the blur's kernel


@dataclass(frozen=True)
class Windows:
    """Where the pixels of a batch of crops lie in their keyframes."""

    keyframes: torch.Tensor  # int64 (b, 1, 1)
    ys: torch.Tensor  # float32 (b, h, w) in pixels of the keyframe, .5 = the middle of the first
    xs: torch.Tensor  # float32 (b, h, w)
    step: torch.Tensor  # float32 (b, 2) pixels of the keyframe per pixel of the crop, down and to the right
    exchanged: torch.Tensor  # bool (b,) whether rows and columns are


class KeyframePool:
    """All keyframes of the rooms that were added, by picture size (upright and not).

    A subclass says which arrays (`arrays_of`) and what a batch of them is (`draw`).
    """

    crop: tuple[int, int]
    """Rows and columns of the crops."""
    zoom: tuple[float, float] = (1.0, 1.0)
    """Least and largest magnification."""
    exchange: float = 0.0
    """Share of crops whose rows and columns are exchanged."""

    def __init__(self, device: str) -> None:
        """Make an empty pool on a torch device."""
        self.device = torch.device(device)
        self._rooms: set[str] = set()
        self._parts: dict[tuple[int, int], dict[str, torch.Tensor]] = {}

    def __len__(self) -> int:
        """Return the number of keyframes."""
        return sum(len(next(iter(part.values()))) for part in self._parts.values())

    def arrays_of(self, room: Room) -> tuple[tuple[int, int], dict[str, np.ndarray]]:
        """Return the picture size of a room, and its arrays to keep, keyframes first."""
        raise NotImplementedError

    def draw(self, count: int, generator: torch.Generator) -> list[torch.Tensor]:
        """Return a batch of crops as the task's `stack` does."""
        raise NotImplementedError

    def add(self, rooms: list[Room]) -> None:
        """Copy the rooms that are not there yet."""
        self.take(self.read(rooms))

    def read(self, rooms: list[Room]) -> dict[tuple[int, int], list[dict[str, np.ndarray]]]:
        """Return the arrays of the rooms that are not there yet, by picture size; another thread may do it."""
        fresh: dict[tuple[int, int], list[dict[str, np.ndarray]]] = {}
        for room in rooms:
            if room.folder.name not in self._rooms:
                self._rooms.add(room.folder.name)
                size, arrays = self.arrays_of(room)
                fresh.setdefault(size, []).append({name: np.array(a) for name, a in arrays.items()})
        return fresh

    def take(self, fresh: dict[tuple[int, int], list[dict[str, np.ndarray]]]) -> None:
        """Copy what `read` returned to the device."""
        for size, parts in fresh.items():
            old = self._parts.get(size)
            self._parts[size] = {
                name: torch.cat(
                    ([] if old is None else [old[name]])
                    + [torch.from_numpy(p[name]).to(self.device) for p in parts]
                )
                for name in parts[0]
            }

    def choose(self, count: int, generator: torch.Generator) -> tuple[dict[str, torch.Tensor], Windows]:
        """Return the arrays of one picture size, each with its share of the batches, and windows in them."""
        counts = {size: len(next(iter(part.values()))) for size, part in self._parts.items()}
        number = int(torch.randint(sum(counts.values()), (1,), generator=generator))
        for size, there in counts.items():
            if number < there:
                return self._parts[size], self._windows(size, there, count, generator)
            number -= there
        raise IndexError(number)

    def _windows(self, size, there: int, count: int, generator: torch.Generator) -> Windows:
        h, w = self.crop
        exchanged = torch.rand(count, generator=generator) < self.exchange
        high = torch.where(exchanged, w, h).float()  # of the crop before rows and columns are exchanged
        wide = torch.where(exchanged, h, w).float()
        low, most = np.log(self.zoom)
        zoom = torch.exp(low + (most - low) * torch.rand(count, generator=generator))
        zoom = torch.maximum(zoom, torch.maximum(high / size[0], wide / size[1]))
        taken = torch.stack([(high / zoom).round(), (wide / zoom).round()], 1)
        corner = (torch.rand(count, 2, generator=generator) * (torch.tensor(size) - taken + 1)).floor()
        mirrored = torch.rand(count, generator=generator) < 0.5
        rows = torch.randint(there, (count,), generator=generator)
        step = taken / torch.stack([high, wide], 1)
        rows, exchanged, mirrored, step, corner, wide = (
            tensor.to(self.device, non_blocking=True)
            for tensor in (rows, exchanged, mirrored, step, corner, wide)
        )
        line = (slice(None), None, None)
        down = torch.arange(h, device=self.device, dtype=torch.float32)[None, :, None]
        right = torch.arange(w, device=self.device, dtype=torch.float32)[None, None, :]
        i = torch.where(exchanged[line], right, down)
        j = torch.where(exchanged[line], down, right)
        j = torch.where(mirrored[line], wide[line] - 1 - j, j)
        ys = corner[:, 0][line] + (i + 0.5) * step[:, 0][line]
        xs = corner[:, 1][line] + (j + 0.5) * step[:, 1][line]
        return Windows(rows[line], ys, xs, step, exchanged)

    @staticmethod
    def nearest(values: torch.Tensor, at: Windows) -> torch.Tensor:
        """Return the values (n, H, W, ...) of the nearest pixels as (b, h, w, ...)."""
        y = at.ys.long().clamp_(0, values.shape[1] - 1)
        x = at.xs.long().clamp_(0, values.shape[2] - 1)
        return values[at.keyframes, y, x]

    @staticmethod
    def smooth(values: torch.Tensor, at: Windows) -> torch.Tensor:
        """Return the values (n, H, W, c) as float32 (b, h, w, c); where they shrink, the mean of four samples."""
        apart = 0.25 * (at.step - 1).clamp_min(0) * at.step.clamp_min(1)
        total = torch.zeros((), device=values.device)
        for sy, sx in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
            y = (at.ys - 0.5 + sy * apart[:, 0, None, None]).clamp(0, values.shape[1] - 1)
            x = (at.xs - 0.5 + sx * apart[:, 1, None, None]).clamp(0, values.shape[2] - 1)
            top, left = y.floor(), x.floor()
            dy, dx = (y - top)[..., None], (x - left)[..., None]
            i, j = top.long(), left.long()
            below, beside = (i + 1).clamp_max(values.shape[1] - 1), (j + 1).clamp_max(values.shape[2] - 1)

            def read(row, column) -> torch.Tensor:
                return values[at.keyframes, row, column].float()

            upper = read(i, j) * (1 - dx) + read(i, beside) * dx
            lower = read(below, j) * (1 - dx) + read(below, beside) * dx
            total = total + 0.25 * (upper * (1 - dy) + lower * dy)
        return total

    def uniform(self, low: float, high: float, shape: tuple[int, ...], generator) -> torch.Tensor:
        """Return random numbers on the device."""
        return (low + (high - low) * torch.rand(shape, generator=generator)).to(self.device)

    def normal(self, spread: float, shape: tuple[int, ...], generator) -> torch.Tensor:
        """Return normally distributed numbers on the device."""
        return (spread * torch.randn(shape, generator=generator)).to(self.device)

    def other_light(self, color: torch.Tensor, generator) -> torch.Tensor:
        """Return pictures (b, 3, h, w), 0 to 1, in another exposure, contrast and color, as `samples.other_light`."""
        n = len(color)

        def chance(share: float) -> torch.Tensor:
            return (self.uniform(0, 1, (n,), generator) < share)[:, None, None, None]

        order = torch.stack([torch.randperm(3, generator=generator) for _ in range(n)]).to(self.device)
        mixed = torch.gather(color, 1, order[:, :, None, None].expand_as(color))
        color = torch.where(chance(0.3), mixed, color)
        color = torch.where(chance(0.15), color.mean(1, keepdim=True), color)
        gain = (
            self.normal(0.25, (n, 1, 1, 1), generator).exp() * self.normal(0.1, (n, 3, 1, 1), generator).exp()
        )
        power = self.normal(0.25, (n, 1, 1, 1), generator).exp()
        color = color.clamp(0, 1) ** power * gain + self.normal(0.04, (n, 1, 1, 1), generator)
        color = torch.where(chance(0.25), self._blurred(color, generator), color)
        noise = torch.randn(color.shape, device=self.device) * self.uniform(0, 0.03, (n, 1, 1, 1), generator)
        color = torch.where(chance(0.5), color + noise, color)
        return torch.where(chance(0.03), torch.full_like(color, 0.5), color).clamp(0, 1)

    def _blurred(self, color: torch.Tensor, generator) -> torch.Tensor:
        n, channels, h, w = color.shape
        at = torch.arange(-_BLUR_PX, _BLUR_PX + 1, device=self.device)
        kernel = torch.exp(-0.5 * (at / self.uniform(0.4, 1.1, (n, 1), generator)) ** 2)
        kernel = (kernel / kernel.sum(1, keepdim=True)).repeat_interleave(channels, 0)
        flat = functional.pad(color.reshape(1, n * channels, h, w), (_BLUR_PX,) * 4, mode="reflect")
        flat = functional.conv2d(flat, kernel[:, None, :, None], groups=n * channels)
        return functional.conv2d(flat, kernel[:, None, None, :], groups=n * channels).reshape(color.shape)


def near_steps(values: torch.Tensor, reach_px: int) -> torch.Tensor:
    """Return which pixels (b, h, w) lie within `reach_px` of a step of depth, as `samples.near_steps`."""
    step = torch.zeros_like(values)
    for axis in (1, 2):
        length = values.shape[axis] - 1
        a, b = values.narrow(axis, 1, length), values.narrow(axis, 0, length)
        jump = (torch.maximum(a, b) > JUMP * torch.minimum(a, b)).to(values.dtype)
        step.narrow(axis, 1, length).copy_(torch.maximum(step.narrow(axis, 1, length), jump))
        step.narrow(axis, 0, length).copy_(torch.maximum(step.narrow(axis, 0, length), jump))
    return functional.max_pool2d(step[:, None], 2 * reach_px + 1, 1, reach_px)[:, 0] > 0
