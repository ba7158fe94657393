"""Depth refinement at occlusion boundaries by a network: depth maps with origins -> maps that end where objects end.

The network classifies every pixel: it lies on one of the surfaces around it, or on none (displacement fields at
occlusion boundaries, Ramamonjisoa et al., CVPR 2020, as a choice among plane hypotheses). Weights ship with the
project; docs/priors.md has their data.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from reconstruction.core.progress import NO_PROGRESS, Progress
from reconstruction.core.types import PosedFrames
from reconstruction.depth.candidates import candidate_depths, choose_candidates
from reconstruction.depth.channels import AFFINITIES, FEATURES
from reconstruction.depth.evidence import COMPLETED, MEASURED, PREDICTED, Evidence, count_views, inverse
from reconstruction.depth.images import small_color

WEIGHTS = Path(__file__).parent / "weights" / "mending.safetensors"
AROUND_PX = 49
"""Side of the window whose mean depth a pixel's depth is told against."""
MANY_VIEWS = 10.0
"""Counts of views are told as shares of it."""
_STRIP_PX = 32  # rows whose candidates are scored at a time
_LOOK_THROUGH = 2  # views that see something beyond a point, from which it may be dropped


def mending_features(
    picture: np.ndarray,
    depth: np.ndarray,
    origin: np.ndarray,
    correlation: np.ndarray,
    agree: np.ndarray,
    through: np.ndarray,
    surety: np.ndarray,
) -> np.ndarray:
    """Return the network's input float32 (FEATURES, h, w); it does not change with the scale of depth.

    Args:
        picture: float32 (h, w, 3), 0 to 1.
        depth: float32 (h, w), 0 = unknown.
        origin: uint8 (h, w), see `evidence`.
        correlation: float32 (h, w), 0 to 1.
        agree: uint8 (h, w) views that see the same point.
        through: uint8 (h, w) views that look through it.
        surety: float32 (h, w), probability of predicted depth.
    """
    import cv2

    known = depth > 0
    log = np.where(known, np.log(np.maximum(depth, 1e-9)), 0).astype(np.float32)
    amount = cv2.boxFilter(known.astype(np.float32), -1, (AROUND_PX, AROUND_PX), normalize=False)
    around = cv2.boxFilter(log, -1, (AROUND_PX, AROUND_PX), normalize=False) / np.maximum(amount, 1)
    middle = np.median(log[known]) if known.any() else 0.0
    beside = np.where(known, log - around, 0)
    out = np.empty((FEATURES, *depth.shape), np.float32)
    out[:3] = picture.transpose(2, 0, 1) - 0.5
    out[3] = np.clip(4 * beside, -2, 2)
    out[4] = np.clip(40 * beside, -2, 2)
    out[5] = np.where(known, np.clip(log - middle, -1.5, 1.5), 0)
    for channel, kind in enumerate((MEASURED, COMPLETED, PREDICTED), start=6):
        out[channel] = origin == kind
    out[9] = np.where(origin == MEASURED, np.clip(correlation, 0, 1), 0)
    out[10] = np.minimum(agree / MANY_VIEWS, 1)
    out[11] = np.minimum(through / MANY_VIEWS, 1)
    out[12] = np.where(origin == PREDICTED, surety, 0)
    return out


def candidate_shares(
    features: np.ndarray, there: np.ndarray, weights: Path = WEIGHTS
) -> tuple[np.ndarray, np.ndarray]:
    """Return the probability of each candidate, and whether neighbors are of one thing.

    The first array, float32 (k, h, w), sums to 1 with what is missing: "none of them". The second, float32 (6, h, w),
    is the probability that a pixel and the one 1 px to its right, 1 px below, 4 px to the right, ... are of one thing
    (`channels.OFFSETS_PX`).

    One thread, so that the result does not depend on how many there are; call it from several.

    Args:
        features: of `mending_features`.
        there: bool (k, h, w), candidates that exist.
        weights: Of the network.
    """
    import torch
    from torch.nn.functional import pixel_unshuffle

    from reconstruction.core.trunk import load_trunk
    from reconstruction.depth.weights import load_network

    torch.set_num_threads(1)
    h, w = features.shape[1:]
    padded = np.pad(features, ((0, 0), (0, h % 2), (0, w % 2)), mode="edge")
    share = np.empty((h, w, len(there) + 1), np.float32)
    together = np.empty((AFFINITIES, h, w), np.float32)
    network = load_network("mending", weights)
    with torch.inference_mode():
        shown = torch.from_numpy(padded)[None]
        found = network.unet(pixel_unshuffle(shown, 2), load_trunk()(2 * shown[:, :3]))
        for top in range(0, h, _STRIP_PX):  # what a strip needs stays in the processor's cache
            rows = slice(top, min(h, top + _STRIP_PX))
            logits, affinity = network.scores(found[:, :, top // 2 : (top + _STRIP_PX) // 2])
            size = rows.stop - top
            logits = logits[0, :, :size, :w].permute(1, 2, 0)  # as they lie in memory
            logits[..., :-1].masked_fill_(torch.from_numpy(~there[:, rows]).permute(1, 2, 0), -1e4)
            share[rows] = logits.softmax(2).numpy()
            together[:, rows] = affinity[0, :, :size, :w].contiguous().sigmoid().numpy()
    return np.moveaxis(share, 2, 0)[:-1], together


def pack_affinities(affinity: np.ndarray) -> np.ndarray:
    """Return affinities (6, h, w) of every second pixel and row as uint8 (6, ceil(h / 2), ceil(w / 2)), 255 for 1."""
    return np.round(255 * affinity[:, ::2, ::2]).astype(np.uint8)


def mend_depth(
    found: Evidence,
    posed: PosedFrames,
    least: float,
    each: Callable,
    progress: Progress = NO_PROGRESS,
    weights: Path = WEIGHTS,
) -> Evidence:
    """Return the evidence with maps mended once: every pixel on the surface that it most probably lies on, or unknown.

    Args:
        found: Maps and the origin of every pixel.
        posed: Their frames.
        least: Probability from which depth is believed.
        each: Runs a function for every frame: each(n, work, label, progress).
        progress: Where steps and shares are reported.
        weights: Of the network.
    """
    agree, through = count_views(found.depth, posed, found.camera, found.neighbors, each, progress)
    depth, origin = np.zeros_like(found.depth), np.zeros_like(found.origin)
    count, h, w = depth.shape
    together = np.zeros((count, AFFINITIES, (h + 1) // 2, (w + 1) // 2), np.uint8)
    nothing = np.zeros(found.depth.shape[1:], np.float32)

    def work(i: int) -> None:
        picture = small_color(posed.images[i], found.camera) / np.float32(255)
        surety = found.surety[i] if len(found.surety) else nothing
        features = mending_features(
            picture, found.depth[i], found.origin[i], found.correlation[i], agree[i], through[i], surety
        )
        own = inverse(found.depth[i])
        candidates = candidate_depths(own)
        share, affinity = candidate_shares(features, candidates > 0, weights)
        together[i] = pack_affinities(affinity)
        rho, trust = np.empty_like(own), np.empty_like(own)
        choose_candidates(candidates, share, np.float32(least), rho, trust)
        kept = rho == own
        depth[i] = np.where(kept, found.depth[i], inverse(rho))
        origin[i] = np.where(depth[i] > 0, np.where(kept, found.origin[i], COMPLETED), 0)

    each(len(depth), work, "mending depth", progress)
    was, now = found.depth > 0, depth > 0
    shares = [100 * float(m.mean()) for m in (was & ~now, was & now & (depth != found.depth), now & ~was)]
    progress.note(
        f"depth: mending dropped {shares[0]:.1f} % of the pixels, moved {shares[1]:.1f} % and filled {shares[2]:.1f} %"
    )
    return replace(found, depth=depth, origin=origin, affinity=together)


def drop_unconfirmed(
    found: Evidence,
    before: np.ndarray,
    posed: PosedFrames,
    least: int,
    each: Callable,
    progress: Progress = NO_PROGRESS,
) -> Evidence:
    """Return the evidence without changed depth that too few views see, or that more look through.

    Args:
        found: Maps and the origin of every pixel.
        before: float32 (n, h, w) the maps before they were mended; what is the same stays.
        posed: Their frames.
        least: Other views that have to see the same point.
        each: Runs a function for every frame: each(n, work, label, progress).
        progress: Where steps and shares are reported.
    """
    changed = found.depth != before
    agree, through = count_views(found.depth, posed, found.camera, found.neighbors, each, progress, changed)
    drop = changed & ((agree < least) | ((through >= _LOOK_THROUGH) & (through > agree + 1)))
    progress.note(
        f"depth: views did not confirm {100 * float((drop & (found.depth > 0)).mean()):.1f} % of the pixels"
    )
    return replace(
        found, depth=np.where(drop, 0, found.depth), origin=np.where(drop, 0, found.origin).astype(np.uint8)
    )
