"""The loss of affinities: whether two pixels some way apart belong to one thing."""

import torch
from torch.nn import functional

from reconstruction.depth.channels import OFFSETS_PX


def affinity_loss(affinity: torch.Tensor, ids: torch.Tensor) -> torch.Tensor:
    """Cross entropy of `one thing` for pairs to the right and below; pairs of two things weigh more, being few."""
    parts = []
    for k, px in enumerate(OFFSETS_PX):
        for channel, (a, b) in enumerate(((ids[:, :, :-px], ids[:, :, px:]), (ids[:, :-px], ids[:, px:]))):
            said = affinity[:, 2 * k + channel]
            said = said[:, :, :-px] if channel == 0 else said[:, :-px]
            same = (a == b).float()
            weight = ((a > 0) & (b > 0)) * (1 + 4 * (1 - same))
            loss = functional.binary_cross_entropy_with_logits(said, same, reduction="none")
            parts.append((weight * loss).sum() / weight.sum().clamp_min(1))
    return torch.stack(parts).mean()
