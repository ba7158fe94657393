"""Training of the aggregation network: its loss, and its figures on whole keyframes."""

from typing import Any

import numpy as np
import torch
from torch.nn import functional

from priors.affinities import affinity_loss
from priors.aggregation_pool import AggregationPool
from priors.pictures import seen_in
from priors.samples import Room, draw_sample, load_sample, stack
from reconstruction.depth.network import Aggregation, place_of

ARRAYS = ("cost", "smoothed", "color", "true_depth", "true_ids", "range")
"""Names of the arrays that a room's folder must hold."""
SCORE = "net_off2"
"""The figure that is least for the best weights."""
POOL = AggregationPool
"""Draws the samples where there is CUDA."""
_SOME = 0.005  # share of a keyframe from which it has a say in the figures of where nothing stands

__all__ = ["ARRAYS", "POOL", "SCORE", "check", "draw_sample", "losses", "make_network", "stack"]


def make_network(config: Any) -> Aggregation:
    """Return the untrained network."""
    return Aggregation(config.widths) if config.widths else Aggregation()


def losses(net: Aggregation, batch, config: Any) -> dict[str, torch.Tensor]:
    """Return the parts of the loss of a batch (see `samples.stack`)."""
    correlation, smoothed, color, place, ids, border, rho = batch
    logits, offset, affinity = net(correlation, smoothed, color, seen_in(color))
    known = place >= 0
    weight = known * (1 + config.border_weight * border)
    total = weight.sum().clamp_min(1)
    log_share = functional.log_softmax(logits.float(), 1)
    # Where nothing stands inside of the sweep no bin is right: all are to be equally probable, so that none is sure.
    nowhere = -log_share.mean(1) - float(np.log(logits.shape[1]))
    low = place.clamp_min(0).floor().long().clamp_max(logits.shape[1] - 2)
    share = (place.clamp_min(0) - low).clamp(0, 1)
    entropy = -(
        (1 - share) * log_share.gather(1, low[:, None])[:, 0]
        + share * log_share.gather(1, low[:, None] + 1)[:, 0]
    )
    found, _ = place_of(log_share.exp(), offset.float())
    start, step = rho[:, 0, None, None], rho[:, 1, None, None]
    # Relative depth in percent, where the right mode won.
    error = 100 * step * (found - place).abs() / (start + step * place.clamp_min(0)).clamp_min(1e-6)
    right = weight * ((found - place).abs() < 2)
    precision = (
        right * functional.smooth_l1_loss(error, torch.zeros_like(error), reduction="none")
    ).sum() / total
    return {
        "entropy": (weight * entropy).sum() / total,
        "nowhere": (~known * nowhere).sum() / known.numel(),
        "precision": 0.25 * precision,
        "affinity": config.affinity_weight * affinity_loss(affinity.float(), ids),
    }


@torch.inference_mode()
def check(net: Aggregation, rooms: list[Room], keyframes: int) -> dict[str, float]:
    """Measure whole keyframes, spread over the rooms: shares of pixels off; semi-global aggregation beside it."""
    sums: dict[str, list[float]] = {}
    rng = np.random.default_rng(0)
    chosen = [(rooms[int(k)], int(rng.integers(1 << 30))) for k in np.linspace(0, len(rooms) - 1, keyframes)]
    device = next(net.parameters()).device
    for room, number in chosen:
        row = number % len(room)
        sample = load_sample(room, row)
        correlation, smoothed, color, place, _, border, _ = stack([sample])
        shown = [tensor.to(device) for tensor in (correlation, smoothed, color)]
        logits, offset, _ = net(*shown, seen_in(shown[2]))
        found, surety = (tensor.cpu() for tensor in place_of(logits.softmax(1), offset))
        start, step = sample.rho
        truth = (start + step * place[0]).numpy()
        known, border = (place[0] >= 0).numpy(), border[0].numpy()
        errors = {"net": (start + step * found[0]).numpy() / truth}
        if "winner" in room.arrays:
            errors["sgm"] = 1 / (np.asarray(room.arrays["winner"][row]) * truth)
        for name, ratio in errors.items():
            off = np.abs(ratio - 1)
            for part, mask in (("", known), ("_border", known & border)):
                if mask.any():
                    sums.setdefault(f"{name}_off5{part}", []).append(float((off[mask] > 0.05).mean()))
                    sums.setdefault(f"{name}_off2{part}", []).append(float((off[mask] > 0.02).mean()))
            sums.setdefault(f"{name}_median", []).append(float(np.median(off[known])))
        if (~known).mean() > _SOME:
            sums.setdefault("sure_nowhere", []).append(float((surety[0].numpy() > 0.6)[~known].mean()))
        sure = known & (surety[0].numpy() > 0.6)
        sums.setdefault("sure", []).append(float(sure.sum() / max(known.sum(), 1)))
        off = np.abs(errors["net"] - 1)
        sums.setdefault("sure_off5", []).append(float((off[sure] > 0.05).mean()) if sure.any() else 0.0)
    return {name: float(np.mean(values)) for name, values in sums.items()}
