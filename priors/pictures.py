"""Features of a batch of pictures by the trunk that was trained on ImageNet, without gradients."""

import torch

from reconstruction.core.trunk import Trunk, load_trunk

_HERE: dict[torch.device, Trunk] = {}


def trunk_on(device: torch.device) -> Trunk:
    """Return the trunk on a device."""
    if device not in _HERE:
        trunk = Trunk()
        trunk.load_state_dict(load_trunk().state_dict())
        _HERE[device] = trunk.eval().requires_grad_(False).to(device)
    return _HERE[device]


@torch.no_grad()
def seen_in(color: torch.Tensor) -> list[torch.Tensor]:
    """Return the trunk's features (`core.trunk.Trunk.forward`) of color (b, 3, h, w), 0 to 1."""
    return trunk_on(color.device)((2 * color - 1).contiguous(memory_format=torch.channels_last))
