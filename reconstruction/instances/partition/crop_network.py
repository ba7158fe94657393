"""The network that scores a proposal from its crops, trained on rooms.

Beside maps of the proposal it sees features of the picture by a trunk trained on ImageNet
(`reconstruction.core.trunk`).
"""

import torch
from torch import nn
from torch.nn import functional

from reconstruction.core.trunk import CHANNELS
from reconstruction.instances.partition.crops import GRID, MAPS, SCALARS

FINE, COARSE = CHANNELS[2:]  # of the trunk at strides of 8 and 16
_WIDTH = 48
_HIDDEN = 96
_DROP_MAPS, _DROP = 0.1, 0.2


class Head(nn.Module):
    """The logit of a proposal's IoU with its best object, from a crop."""

    def __init__(self) -> None:
        """Make the layers; weights are random until loaded."""
        super().__init__()
        w = _WIDTH
        self.fine = nn.Sequential(nn.BatchNorm2d(FINE), nn.Conv2d(FINE, w, 1), nn.Dropout2d(_DROP_MAPS))
        self.coarse = nn.Sequential(nn.BatchNorm2d(COARSE), nn.Dropout2d(_DROP_MAPS), nn.Conv2d(COARSE, w, 1))
        self.maps = nn.Sequential(*_convolution(len(MAPS), w // 2), nn.Conv2d(w // 2, w, 3, 2, 1))
        self.beside = nn.Sequential(*_activation(w), *_convolution(w, w), nn.Conv2d(w, w, 3, 1, 1))
        self.wide = nn.Sequential(
            *_activation(w), *_convolution(w, 2 * w, 2), nn.Conv2d(2 * w, 2 * w, 3, 1, 1), *_activation(2 * w)
        )
        self.scalars = nn.BatchNorm1d(len(SCALARS))
        self.out = nn.Sequential(
            nn.Linear(6 * w + len(SCALARS), _HIDDEN), nn.ReLU(), nn.Dropout(_DROP), nn.Linear(_HIDDEN, 1)
        )

    def forward(
        self, fine: torch.Tensor, coarse: torch.Tensor, maps: torch.Tensor, scalars: torch.Tensor
    ) -> torch.Tensor:
        """Return the logits (b,).

        Args:
            fine: float (b, FINE, GRID / 2, GRID / 2), the trunk's.
            coarse: float (b, COARSE, GRID / 4, GRID / 4), the trunk's.
            maps: float (b, len(MAPS), GRID, GRID).
            scalars: float (b, len(SCALARS)).
        """
        coarse = functional.interpolate(self.coarse(coarse), size=GRID // 2, mode="bilinear")
        x = self.maps(maps) + self.fine(fine) + coarse
        x = self.wide(x + self.beside(x))
        inside = functional.avg_pool2d(0.5 + 0.5 * maps[:, :1], 4)
        pooled = [_mean(x, inside), _mean(x, 1 - inside), x.amax((2, 3))]
        return self.out(torch.cat([*pooled, self.scalars(scalars)], 1))[:, 0]


def _activation(channels: int) -> tuple[nn.Module, ...]:
    return nn.BatchNorm2d(channels), nn.ReLU()


def _convolution(a: int, b: int, stride: int = 1) -> tuple[nn.Module, ...]:
    return nn.Conv2d(a, b, 3, stride, 1), nn.BatchNorm2d(b), nn.ReLU()


def _mean(x: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
    return (x * weight).sum((2, 3)) / (weight.sum((2, 3)) + 1e-3)
