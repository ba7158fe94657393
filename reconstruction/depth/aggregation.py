"""Learned cost aggregation: matching costs and picture of a keyframe -> inverse depth and its probability.

Weights ship with the project; docs/priors.md has the network and its data.
"""

from pathlib import Path

import numpy as np

from reconstruction.depth.channels import BINS, PLANES

WEIGHTS = Path(__file__).parent / "weights" / "aggregation.safetensors"
_HOPELESS = 508.0  # bins whose aggregated cost exceeds the winner's by this much score 0


def bin_costs(cost: np.ndarray) -> np.ndarray:
    """Return the least cost inside each bin, uint8 (h, w, BINS), of costs (h, w, planes) of at least as many planes."""
    from reconstruction.depth.sgm import least_in_bins

    out = np.empty((*cost.shape[:2], BINS), np.uint8)
    least_in_bins(cost, np.arange(BINS + 1) * cost.shape[2] // BINS, out)
    return out


def smoothed_scores(binned: np.ndarray, gray: np.ndarray, small: float, large: float) -> np.ndarray:
    """Return what semi-global aggregation says of every bin, uint8 (h, w, BINS): 255 for the winner, less for others.

    Args:
        binned: costs of `bin_costs`.
        gray: float32 (h, w), gray levels; where they change, so may depth.
        small: penalty of a change by one bin, in units of correlation.
        large: penalty of a jump, in units of correlation.
    """
    from reconstruction.depth.sgm import aggregate, score_bins

    p1, p2 = np.int32(max(1, round(127 * small))), np.int32(round(127 * large))
    total = np.zeros(binned.shape, np.uint16)
    aggregate(np.ascontiguousarray(binned), gray, p1, p2, p1 + np.int32(1), 8.0, total)
    out = np.empty(binned.shape, np.uint8)
    score_bins(total, np.float32(_HOPELESS), out)
    return out


def line_of_places(far: float, near: float, planes: int) -> tuple[float, float]:
    """Return the inverse depth at place 0 and its step from bin to bin, for planes spaced evenly from far to near."""
    step = (1.0 / near - 1.0 / far) / (planes - 1)
    per_bin = planes / BINS
    return 1.0 / far + (0.5 * per_bin - 0.5) * step, per_bin * step


def place_of_depth(depth: np.ndarray, far: float, near: float) -> tuple[np.ndarray, tuple[float, float]]:
    """Return the place in bins of each depth, -1 where unknown or outside of the sweep, and the line of places."""
    start, step = line_of_places(far, near, PLANES)
    place = (1.0 / np.maximum(depth, 1e-9) - start) / step
    inside = (depth > 0) & (place > -0.5) & (place < BINS - 0.5)
    return np.where(inside, np.clip(place, 0, BINS - 1), -1.0), (start, step)


def aggregate_costs(
    cost: np.ndarray,
    color: np.ndarray,
    gray: np.ndarray,
    rhos: np.ndarray,
    penalties: tuple[float, float],
    weights: Path = WEIGHTS,
) -> tuple[np.ndarray, np.ndarray]:
    """Return inverse depth float32 (h, w) and the probability float32 (h, w) of the surface that it is on.

    One thread, so that the result does not depend on how many there are; call it from several.

    Args:
        cost: uint8 (h, w, planes), 127 * (1 - correlation); 127 where no source sees the pixel.
        color: (h, w, 3), 0 to 255.
        gray: float32 (h, w), gray levels.
        rhos: (planes,) inverse depth of the planes, evenly spaced, far to near.
        penalties: Of small and of large changes, in units of correlation, as `smoothed_scores` takes them.
        weights: Of the network.
    """
    import torch

    from reconstruction.core.trunk import load_trunk
    from reconstruction.depth.network import place_of
    from reconstruction.depth.weights import load_network

    torch.set_num_threads(1)
    h, w = cost.shape[:2]
    binned = bin_costs(cost)
    correlation = np.float32(1) - binned.astype(np.float32) / 127
    smoothed = smoothed_scores(binned, gray, *penalties).astype(np.float32) / 255
    picture = color.astype(np.float32) / 255
    spare = ((0, h % 2), (0, w % 2), (0, 0))
    tensors = [
        torch.from_numpy(np.pad(array, spare, mode="edge")[None]).permute(0, 3, 1, 2)
        for array in (correlation, smoothed, picture)
    ]
    with torch.inference_mode():
        seen = load_trunk()(2 * tensors[2] - 1)
        logits, offset, _ = load_network("aggregation", weights)(*tensors, seen)
        share = logits.permute(0, 2, 3, 1).softmax(3).permute(0, 3, 1, 2)  # as they lie in memory
        place, surety = place_of(share, offset)
    start, step = line_of_places(1.0 / rhos[0], 1.0 / rhos[-1], len(rhos))
    rho = start + step * place[0, :h, :w].numpy()
    return np.maximum(rho, 0.25 * rhos[0]).astype(np.float32), surety[0, :h, :w].numpy()
