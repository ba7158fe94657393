"""Networks of the depth stage: `Aggregation` scores depth bins of costs, `Mending` scores candidate depths of maps.

A U-Net of 2D convolutions over the plane sweep's costs, planes as channels (SimpleRecon, Sayed et al., ECCV 2022). Its
output is added to what semi-global aggregation says, so that the untrained network is that, and training only has to
learn where it is wrong: beside occlusion borders and on blank regions. Beside costs or maps the U-Nets see features of
the picture by a trunk that was trained on ImageNet (`reconstruction.core.trunk`), as SimpleRecon's image prior.
"""

from itertools import pairwise

import torch
from torch import nn
from torch.nn import functional

from reconstruction.core.trunk import CHANNELS
from reconstruction.depth.candidates import OFFSETS
from reconstruction.depth.channels import BINS, FEATURES, OFFSETS_PX

WIDTHS = (48, 64, 96, 128, 128)
"""Channels at a half, a quarter, ... of the resolution."""
MENDING_WIDTHS = (40, 64, 96, 128, 128)
"""The same of the mending network."""
_DROP = 0.1  # share of the trunk's channels that training leaves out


def _block(a: int, b: int) -> nn.Sequential:
    return nn.Sequential(nn.Conv2d(a, b, 3, padding=1, bias=False), nn.BatchNorm2d(b), nn.ReLU(inplace=True))


class _Look(nn.Sequential):
    """Channels for the U-Net from features of the trunk; none until trained."""

    def __init__(self, a: int, b: int) -> None:
        mix = nn.Conv2d(a, b, 1, bias=False)
        nn.init.zeros_(mix.weight)
        super().__init__(nn.BatchNorm2d(a), nn.Dropout2d(_DROP), mix)


class UNet(nn.Module):
    """Convolutions at a half to 1/32 of the resolution with skip connections, for features at a half of it.

    At each resolution that the trunk has, its features of the picture are added.
    """

    def __init__(self, inputs: int, widths: tuple[int, ...] = WIDTHS) -> None:
        """Make the layers; weights are random until loaded."""
        super().__init__()
        self.enter = _block(inputs, widths[0])
        self.down = nn.ModuleList(nn.Sequential(_block(a, b), _block(b, b)) for a, b in pairwise(widths))
        self.narrow = nn.ModuleList(
            nn.Conv2d(a, b, 1) for a, b in zip(widths[:0:-1], widths[-2::-1], strict=True)
        )
        self.up = nn.ModuleList(_block(2 * b, b) for b in widths[-2::-1])
        self.look = nn.ModuleList(_Look(a, b) for a, b in zip(CHANNELS, widths, strict=False))

    def forward(self, x: torch.Tensor, seen: list[torch.Tensor]) -> torch.Tensor:
        """Map (b, inputs, h, w) to (b, widths[0], h, w).

        Args:
            x: Features at a half of the picture's resolution.
            seen: Features of the picture, of `core.trunk.Trunk`.
        """
        x = self.enter(x.contiguous(memory_format=torch.channels_last))  # convolutions are faster so
        kept = [x + self.look[0](seen[0])]
        for level, layer in enumerate(self.down, start=1):
            x = layer(functional.max_pool2d(kept[-1], 2, ceil_mode=True))
            kept.append(x + self.look[level](seen[level]) if level < len(self.look) else x)
        x = kept.pop()
        for narrow, up in zip(self.narrow, self.up, strict=True):
            skip = kept.pop()
            wide = functional.interpolate(narrow(x), size=skip.shape[-2:], mode="bilinear")
            x = up(torch.cat([wide, skip], 1))
        return x


class Mending(nn.Module):
    """Which of a pixel's candidate depths are right, and whether neighbors belong to one thing.

    Beside the candidates (`candidates.OFFSETS`) stands "none of them". As in `Aggregation`, convolutions run on blocks
    of 2x2 pixels.
    """

    def __init__(self, widths: tuple[int, ...] = MENDING_WIDTHS) -> None:
        """Make the layers; the last one starts at zero but for a lean toward a pixel's own depth."""
        super().__init__()
        self.unet = UNet(4 * FEATURES, tuple(widths))
        self.candidates = len(OFFSETS)
        self.leave = nn.Conv2d(widths[0], 4 * (self.candidates + 1 + 2 * len(OFFSETS_PX)), 1)
        for values in self.leave.parameters():
            nn.init.zeros_(values)
        with torch.no_grad():
            self.leave.get_parameter("bias")[:4] = 3.0

    def forward(self, features: torch.Tensor, seen: list[torch.Tensor]):
        """Return logits (b, candidates + 1, h, w), the last of "none", and affinity logits (b, 6, h, w).

        Args:
            features: (b, FEATURES, h, w) of `mending.mending_features`; height and width are even.
            seen: Features of the picture, of `core.trunk.Trunk`.
        """
        return self.scores(self.unet(functional.pixel_unshuffle(features, 2), seen))

    def scores(self, found: torch.Tensor):
        """Map features (b, widths[0], h / 2, w / 2) of the U-Net to the logits that `forward` returns."""
        out = functional.pixel_shuffle(self.leave(found), 2)
        return out[:, : self.candidates + 1], out[:, self.candidates + 1 :]


class Aggregation(nn.Module):
    """Scores of depth bins, an offset inside the bin, and whether neighbors belong to one thing.

    All convolutions run at half the resolution, on blocks of 2x2 pixels (ESPCN, Shi et al., CVPR 2016): each block's
    features hold its four pixels' colors, and each pixel has its own scores.
    """

    def __init__(self, widths: tuple[int, ...] = WIDTHS) -> None:
        """Make the layers; the last one starts at zero."""
        super().__init__()
        self.sharpness = nn.Parameter(torch.tensor(24.0))
        self.costs = nn.Conv2d(2 * BINS, 40, 2, stride=2)
        self.unet = UNet(40 + 12, tuple(widths))
        outputs = BINS + 1 + 2 * len(OFFSETS_PX)
        self.leave = nn.Conv2d(widths[0], 4 * outputs, 1)
        for values in self.leave.parameters():
            nn.init.zeros_(values)

    def forward(
        self, correlation: torch.Tensor, smoothed: torch.Tensor, color: torch.Tensor, seen: list[torch.Tensor]
    ):
        """Return logits (b, bins, h, w), offset in bins (b, h, w) and affinity logits (b, 6, h, w).

        Args:
            correlation: (b, bins, h, w), -1 to 1, best correlation inside each bin, far to near; 0 = unknown. Height
                and width are even.
            smoothed: (b, bins, h, w), 0 to 1, what semi-global aggregation says of each bin, 1 for its winner.
            color: (b, 3, h, w), 0 to 1.
            seen: Features of the picture, of `core.trunk.Trunk`.
        """
        matched = self.costs(torch.cat([correlation, smoothed], 1))
        features = torch.cat([matched, functional.pixel_unshuffle(color - 0.5, 2)], 1)
        out = functional.pixel_shuffle(self.leave(self.unet(features, seen)), 2)
        logits = self.sharpness * smoothed + out[:, :BINS]
        return logits, torch.tanh(out[:, BINS]), out[:, BINS + 1 :]


def place_of(share: torch.Tensor, offset: torch.Tensor, reach: int = 2):
    """Return the place (b, h, w) of the strongest mode in bins, and the probability that it holds.

    The expected bin over the best one and `reach` to each side, moved by the offset: bins of another surface have no
    say.

    Args:
        share: (b, bins, h, w), the softmax of the logits.
        offset: (b, h, w), in bins.
        reach: Bins to each side of the best one.
    """
    best = share.max(1, keepdim=True).indices
    near = torch.arange(-reach, reach + 1, device=share.device).view(1, -1, 1, 1) + best
    inside = (near >= 0) & (near < share.shape[1])
    near = near.clamp(0, share.shape[1] - 1)
    mass = torch.gather(share, 1, near) * inside
    total = mass.sum(1)
    place = (mass * near).sum(1) / total.clamp_min(1e-6) + offset
    return place, total
