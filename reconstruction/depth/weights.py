"""Loading of the depth stage's networks from the weights that ship with the project."""

from functools import lru_cache
from pathlib import Path

from registry.errors import EnvironmentMissing


@lru_cache(maxsize=4)
def load_network(kind: str, weights: Path):
    """Return a network (`torch.nn.Module`) in evaluation mode, its normalizations folded into the convolutions.

    Args:
        kind: "aggregation" or "mending".
        weights: A safetensors file; its shapes say how wide the layers are.

    Raises:
        EnvironmentMissing: the file is not there or not what this version reads.
    """
    import torch
    from safetensors import SafetensorError
    from safetensors.torch import load_file
    from torch.nn.utils.fusion import fuse_conv_bn_eval

    from reconstruction.depth.network import Aggregation, Mending

    try:
        state = load_file(weights)
        widths = tuple(state[f"unet.{name}.weight"].shape[0] for name in _first_layers(state))
        network = {"aggregation": Aggregation, "mending": Mending}[kind](widths)
        network.load_state_dict({k: v.float() if v.is_floating_point() else v for k, v in state.items()})
    except (OSError, KeyError, RuntimeError, SafetensorError) as error:
        raise EnvironmentMissing(
            f"depth: the weights {weights} cannot be read ({error}). Install the package again, or turn them off with "
            "--set depth.prior=none."
        ) from error
    network.eval()
    for module in network.modules():
        if isinstance(module, torch.nn.Sequential) and isinstance(module[0], torch.nn.Conv2d):
            fused = fuse_conv_bn_eval(module[0], module[1])  # pyright: ignore[reportArgumentType]
            module[0], module[1] = fused, torch.nn.Identity()
    return network


def _first_layers(state: dict) -> list[str]:
    deeper = sorted({int(k.split(".")[2]) for k in state if k.startswith("unet.down.")})
    return ["enter.0", *(f"down.{i}.0.0" for i in deeper)]
