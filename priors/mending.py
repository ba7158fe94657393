"""Training of the mending network: its samples, its loss, and its figures on whole keyframes."""

from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
import torch

from priors.affinities import affinity_loss
from priors.mending_pool import (
    AGREED,
    BESIDE_PX,
    BESIDE_WEIGHT,
    CROP,
    EXCHANGED,
    LEFT_OUT,
    MISSING,
    NONE,
    SPREAD,
    ZOOM,
    MendingPool,
)
from priors.pictures import seen_in
from priors.samples import Room, near_steps, other_light
from reconstruction.depth.candidates import OFFSETS, candidate_depths, choose_candidates
from reconstruction.depth.evidence import MEASURED, PREDICTED, inverse
from reconstruction.depth.mending import mending_features
from reconstruction.depth.network import Mending

ARRAYS = ("picture", "depth", "origin", "agreed", "correlation", "surety", "exact_depth", "exact_ids")
"""Names of the arrays that a room's folder must hold."""
SCORE = "entropy"
"""The figure that is least for the best weights."""
POOL = MendingPool
"""Draws the samples where there is CUDA."""
_OFF = 0.05
_SOME = 0.005  # share of a keyframe from which it has a say in the figures of where nothing stands


@dataclass(frozen=True)
class Sample:
    """One keyframe's maps, or a crop of them."""

    features: np.ndarray  # float32 (FEATURES, h, w)
    candidates: np.ndarray  # float32 (k, h, w) inverse depths, 0 = none
    truth: np.ndarray  # float32 (h, w) true depth, 0 = unknown
    ids: np.ndarray  # int32 (h, w)


def make_network(config: Any) -> Mending:
    """Return the untrained network."""
    return Mending(config.widths) if config.widths else Mending()


def load_sample(
    room: Room, row: int, window: tuple[slice, slice] = (slice(None), slice(None)), *,
    agreed: bool = False, predictions: bool = True, disturb: "Disturbance | None" = None,
) -> Sample:  # fmt: skip
    """Read a keyframe, or a window of it.

    Args:
        room: Its room.
        row: Its number in the room.
        window: Rows and columns.
        agreed: Whether what was measured alone stands in place of the completed maps.
        predictions: Whether predictions of the aggregation network stay.
        disturb: Changes what does not matter; None: left as it is.
    """

    def read(name: str, smooth: bool = False) -> np.ndarray:
        cut = np.asarray(room.arrays[name][row][window])
        return cut if disturb is None else disturb.reshape(cut, smooth)

    kind = "agreed" if agreed else "depth"
    counts = ("agreed_agree", "agreed_through") if agreed else ("agree", "through")
    depth = read(kind).astype(np.float32)
    origin = np.where(depth > 0, MEASURED, 0).astype(np.uint8) if agreed else read("origin").copy()
    if not predictions:
        depth[origin == PREDICTED] = 0
        origin[origin == PREDICTED] = 0
    picture = read("picture", smooth=True).astype(np.float32) / 255
    if disturb is not None:
        picture = other_light(picture.transpose(2, 0, 1), disturb.rng).transpose(1, 2, 0)
    agree, through = (np.where(depth > 0, read(name), 0) for name in counts)
    features = mending_features(
        picture, depth, origin, read("correlation").astype(np.float32) / 100, agree, through,
        read("surety").astype(np.float32) / 100,
    )  # fmt: skip
    truth = read("exact_depth").astype(np.float32)
    return Sample(features, candidate_depths(inverse(depth)), truth, read("exact_ids").astype(np.int32))


@dataclass(frozen=True)
class Disturbance:
    """Another size, mirrored, rows and columns exchanged, and another light (`other_light`, by `rng`)."""

    size: tuple[int, int]  # rows and columns, before they are exchanged
    mirrored: bool
    exchanged: bool
    rng: np.random.Generator

    def reshape(self, array: np.ndarray, smooth: bool) -> np.ndarray:
        """Return an array (h, w, ...) in the other size; `smooth` mixes neighbors, as pictures may."""
        import cv2

        kind = array.dtype
        wide = array.astype(np.float32) if kind in (np.float16, np.uint16) else array
        shrinks = self.size[0] < len(array)
        how = (cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR) if smooth else cv2.INTER_NEAREST
        out = cv2.resize(np.ascontiguousarray(wide), self.size[::-1], interpolation=how).astype(kind)
        out = out[:, ::-1] if self.mirrored else out
        return np.ascontiguousarray(np.swapaxes(out, 0, 1) if self.exchanged else out)


def draw_sample(room: Room, rng: np.random.Generator) -> Sample:
    """Draw a keyframe, a crop of it, the maps it comes with, and disturb what does not matter."""
    row = int(rng.integers(len(room)))
    h, w = room.arrays["depth"].shape[1:3]
    exchanged = bool(rng.random() < EXCHANGED)
    size = CROP[::-1] if exchanged else CROP
    zoom = float(np.exp(rng.uniform(*np.log(ZOOM))))
    zoom = max(zoom, size[0] / h, size[1] / w)
    high, wide = (min(round(s / zoom), limit) for s, limit in zip(size, (h, w), strict=True))
    y, x = int(rng.integers(h - high + 1)), int(rng.integers(w - wide + 1))
    disturb = Disturbance(size, bool(rng.random() < 0.5), exchanged, rng)
    return load_sample(
        room, row, (slice(y, y + high), slice(x, x + wide)), disturb=disturb,
        agreed=bool(rng.random() < AGREED), predictions=bool(rng.random() >= LEFT_OUT),
    )  # fmt: skip


def stack(samples: list[Sample]) -> list[torch.Tensor]:
    """Return features, log likelihoods (b, k + 1, h, w), weights (b, h, w) and ids as tensors with a batch axis."""
    columns = [
        np.stack([s.features for s in samples]), np.stack([likelihoods(s) for s in samples]),
        np.stack([_weights(s) for s in samples]), np.stack([s.ids for s in samples]),
    ]  # fmt: skip
    return [torch.from_numpy(np.ascontiguousarray(c)) for c in columns]


def likelihoods(sample: Sample) -> np.ndarray:
    """Return the log likelihood float32 (k + 1, h, w) of the true depth under each candidate, "none" last.

    Where nothing stands (truth 0) no candidate is right.
    """
    out = np.empty((len(sample.candidates) + 1, *sample.truth.shape), np.float32)
    out[-1] = NONE
    _compare(sample.candidates, sample.truth, out)
    return out


def _weights(sample: Sample) -> np.ndarray:
    there = (sample.candidates > 0).any(0)
    return (there * np.where(beside_steps(sample.truth), BESIDE_WEIGHT, 1)).astype(np.float32)


@numba.njit(cache=True)
def _compare(candidates, truth, out):  # pragma: no cover - compiled
    k, h, w = candidates.shape
    for j in range(k):
        for y in range(h):
            for x in range(w):
                c = candidates[j, y, x]
                out[j, y, x] = -abs(c * truth[y, x] - np.float32(1)) / np.float32(SPREAD)
                if c <= 0:
                    out[j, y, x] = np.float32(MISSING)


def beside_steps(depth: np.ndarray) -> np.ndarray:
    """Return which pixels (h, w) lie within a few pixels of a step of the true depth."""
    return near_steps(depth, BESIDE_PX)


def _entropy(logits: torch.Tensor, likelihood, weight) -> torch.Tensor:
    """Negative log likelihood of the true depth: a mixture of the candidates and of "none of them"."""
    logits = logits.float().masked_fill(likelihood <= 0.5 * MISSING, MISSING)
    told = torch.logsumexp(logits + likelihood, 1) - torch.logsumexp(logits, 1)
    return -(weight * told).sum() / weight.sum().clamp_min(1)


def losses(net: Mending, batch, config: Any) -> dict[str, torch.Tensor]:
    """Return the parts of the loss of a batch (see `stack`)."""
    features, likelihood, weight, ids = batch
    logits, affinity = net(features, seen_in(features[:, :3] + 0.5))
    return {
        "entropy": _entropy(logits, likelihood, weight),
        "affinity": config.affinity_weight * affinity_loss(affinity.float(), ids),
    }


@torch.inference_mode()
def check(net: Mending, rooms: list[Room], keyframes: int) -> dict[str, float]:
    """Measure whole keyframes, spread over the rooms: known and off before and after, everywhere and beside steps."""
    sums: dict[str, list[float]] = {}

    def add(name: str, value: float) -> None:
        sums.setdefault(name, []).append(float(value))

    rng, device = np.random.default_rng(0), next(net.parameters()).device
    chosen = [(rooms[int(k)], int(rng.integers(1 << 30))) for k in np.linspace(0, len(rooms) - 1, keyframes)]
    for room, number in chosen:
        for agreed in (False, True):
            sample = load_sample(room, number % len(room), agreed=agreed)
            features, likelihood, weight, ids = stack([sample])
            shown = features.to(device)
            logits, affinity = (tensor.cpu() for tensor in net(shown, seen_in(shown[:, :3] + 0.5)))
            share = logits.float().masked_fill(likelihood <= 0.5 * MISSING, MISSING).softmax(1)[0].numpy()
            mark = "agreed_" if agreed else ""
            add(mark + "entropy", _entropy(logits, likelihood, weight))
            add(mark + "affinity", affinity_loss(affinity.float(), ids))
            found, trust = (np.zeros(sample.truth.shape, np.float32) for _ in range(2))
            choose_candidates(sample.candidates, share[: len(OFFSETS)], np.float32(0.5), found, trust)
            steps = beside_steps(sample.truth)
            for name, rho in (("before", sample.candidates[0]), ("after", found)):
                for part, mask in (("", sample.truth > 0), ("_steps", (sample.truth > 0) & steps)):
                    known = mask & (rho > 0)
                    off = np.abs(rho * sample.truth - 1) > _OFF
                    add(f"{mark}known_{name}{part}", known.sum() / max(mask.sum(), 1))
                    add(f"{mark}off_{name}{part}", off[known].mean() if known.any() else 0.0)
                void = sample.truth == 0
                if void.mean() > _SOME:
                    add(f"{mark}void_{name}", (rho[void] > 0).mean())
    return {name: float(np.mean(values)) for name, values in sums.items()}
