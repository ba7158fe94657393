"""Networks that score a proposal from its crops: a trunk trained on ImageNet, and a head trained on rooms.

The trunk is EfficientNet-Lite0 (Tan and Le, ICML 2019) up to its stride of 16. It stays as ImageNet left it: what it
says of a picture carries over from generated rooms to real ones. The head sees it beside maps of the proposal.
"""

import torch
from torch import nn
from torch.nn import functional

from reconstruction.instances.partition.crops import GRID, MAPS, SCALARS

FINE, COARSE = 40, 112  # channels of the trunk at strides of 8 and 16
_STAGES = (  # layers, kernel, stride, expansion, channels; Tan and Le, table 1
    (1, 3, 1, 1, 16), (2, 3, 2, 6, 24), (2, 5, 2, 6, FINE), (3, 3, 2, 6, 80), (3, 5, 1, 6, COARSE),
)  # fmt: skip
_STEM = 32
_WIDTH = 48
_HIDDEN = 96
_DROP_MAPS, _DROP = 0.1, 0.2


class _Convolution(nn.Conv2d):
    """A convolution padded as TensorFlow does: outputs cover the image evenly, odd padding comes last."""

    def __init__(self, inputs: int, outputs: int, kernel: int, stride: int = 1, groups: int = 1) -> None:
        # Without a stride the padding is even, and the convolution's own is faster.
        super().__init__(
            inputs, outputs, kernel, stride, padding=kernel // 2 if stride == 1 else 0, groups=groups
        )

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        kernel, stride = self.kernel_size[0], self.stride[0]
        if stride > 1:
            padding = [0, 0, 0, 0]
            for axis, size in enumerate((x.shape[-1], x.shape[-2])):
                total = max((-(-size // stride) - 1) * stride + kernel - size, 0)
                padding[2 * axis : 2 * axis + 2] = total // 2, total - total // 2
            x = functional.pad(x, padding)
        return super().forward(x)


class _Block(nn.Module):
    """An inverted residual (Sandler et al., CVPR 2018), batch normalization folded into its convolutions."""

    def __init__(self, inputs: int, outputs: int, kernel: int, stride: int, expansion: int) -> None:
        super().__init__()
        inner = inputs * expansion
        self.expand = _Convolution(inputs, inner, 1) if expansion > 1 else None
        self.depthwise = _Convolution(inner, inner, kernel, stride, inner)
        self.project = _Convolution(inner, outputs, 1)
        self.residual = stride == 1 and inputs == outputs

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        y = x if self.expand is None else functional.relu6(self.expand(x), inplace=True)
        y = self.project(functional.relu6(self.depthwise(y), inplace=True))
        return x + y if self.residual else y


class Trunk(nn.Module):
    """Features of color."""

    def __init__(self) -> None:
        """Make the layers; weights are random until loaded."""
        super().__init__()
        self.stem = _Convolution(3, _STEM, 3, 2)
        self.blocks = nn.ModuleList()
        channels = _STEM
        for layers, kernel, stride, expansion, outputs in _STAGES:
            for layer in range(layers):
                self.blocks.append(_Block(channels, outputs, kernel, 1 if layer else stride, expansion))
                channels = outputs

    def forward(self, color: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Map color (b, 3, h, w), -1 to 1, to features (b, FINE, h / 8, w / 8) and (b, COARSE, h / 16, w / 16)."""
        x, fine = functional.relu6(self.stem(color), inplace=True), color
        for block in self.blocks:
            x = block(x)
            if x.shape[1] == FINE:
                fine = x
        return fine, x


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
