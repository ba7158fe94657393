"""Features of pictures by a trunk that was trained on ImageNet: EfficientNet-Lite0 up to its stride of 16.

Tan and Le, EfficientNet, ICML 2019. The trunk stays as ImageNet left it: what it says of a picture carries over from
generated rooms to real ones. docs/priors.md has its source and licence.
"""

from functools import lru_cache
from pathlib import Path

import torch
from torch import nn
from torch.nn import functional

from registry.errors import EnvironmentMissing

WEIGHTS = Path(__file__).parent / "weights" / "trunk.safetensors"
CHANNELS = (16, 24, 40, 112)
"""Of the features at strides of 2, 4, 8 and 16."""
_STAGES = (  # layers, kernel, stride, expansion, channels; Tan and Le, table 1
    (1, 3, 1, 1, 16), (2, 3, 2, 6, 24), (2, 5, 2, 6, 40), (3, 3, 2, 6, 80), (3, 5, 1, 6, 112),
)  # fmt: skip
_STEM = 32


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
    """Features of color at four strides."""

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

    def forward(self, color: torch.Tensor) -> list[torch.Tensor]:
        """Return features (b, CHANNELS[k], ceil(h / 2, 4, 8, 16), ...) of color (b, 3, h, w), -1 to 1."""
        x, found = functional.relu6(self.stem(color), inplace=True), {}
        for block in self.blocks:
            x = block(x)
            found[x.shape[1]] = x
        return [found[channels] for channels in CHANNELS]


@lru_cache(maxsize=2)
def load_trunk(weights: Path = WEIGHTS) -> Trunk:
    """Return the trunk in evaluation mode, with the weights that ship.

    Raises:
        EnvironmentMissing: the file is not there or not what this version reads.
    """
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    trunk = Trunk()
    try:
        trunk.load_state_dict({name: value.float() for name, value in load_file(weights).items()})
    except (OSError, RuntimeError, SafetensorError) as error:
        raise EnvironmentMissing(
            f"the weights {weights} cannot be read ({error}). Install the package again."
        ) from error
    return trunk.eval().requires_grad_(False)
