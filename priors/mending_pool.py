"""Crops for the mending network, drawn and disturbed on a device: features and candidate depths are computed there.

`mending_features` and `candidate_depths` are those of `reconstruction.depth`, for a batch.
"""

import math

import numpy as np
import torch
from torch.nn import functional

from priors.keyframe_pool import KeyframePool, near_steps
from priors.samples import Room
from reconstruction.depth.candidates import JUMP, MOST_BENT, OFFSETS, SLOPE_REACH, SLOPE_STRIDE
from reconstruction.depth.channels import FEATURES
from reconstruction.depth.evidence import COMPLETED, MEASURED, PREDICTED
from reconstruction.depth.mending import AROUND_PX, MANY_VIEWS

CROP = (192, 224)
ZOOM = (0.55, 1.25)
EXCHANGED = 0.3
"""Share of samples whose rows and columns are exchanged."""
LEFT_OUT = 0.5
"""Share of samples without predictions."""
AGREED = 0.2
"""Share of samples with what was measured alone."""
BESIDE_PX, BESIDE_WEIGHT = 9, 4
"""Within so many pixels of steps of the true depth a pixel weighs more."""
SPREAD = 0.015
"""Scale of a right candidate's relative error, the noise of the measurement (Laplace)."""
NONE = -3.0
"""Log likelihood of "none of them": that of a candidate three spreads off."""
MISSING = -1e4
"""Log likelihood of a candidate that does not exist."""
_JUMP, _MOST_BENT = float(JUMP), float(MOST_BENT)
_OFFSETS, _FARTHEST = OFFSETS.tolist(), int(np.abs(OFFSETS).max())
_FIT_REACH = 2  # of `refine.fit_slopes`
_FEW = 6  # pixels of a fit


class MendingPool(KeyframePool):
    """Depth maps as the pipeline makes them, their pictures, and truth."""

    crop, zoom, exchange = CROP, ZOOM, EXCHANGED

    def arrays_of(self, room: Room) -> tuple[tuple[int, int], dict[str, np.ndarray]]:
        """Return the arrays of a room."""
        a = room.arrays
        names = (
            "picture", "depth", "origin", "agree", "through", "agreed", "agreed_agree", "agreed_through",
            "correlation", "surety", "exact_depth",
        )  # fmt: skip
        kept = {name: a[name] for name in names} | {"exact_ids": a["exact_ids"].astype(np.int16)}
        return tuple(a["depth"].shape[1:3]), kept

    def draw(self, count: int, generator: torch.Generator) -> list[torch.Tensor]:
        """Return a batch of crops as `mending.stack` does: features, log likelihoods, weights, ids."""
        part, at = self.choose(count, generator)
        agreed = (self.uniform(0, 1, (count, 1, 1), generator) < AGREED).expand(at.ys.shape)
        left_out = self.uniform(0, 1, (count, 1, 1), generator) < LEFT_OUT
        read = {name: self.nearest(part[name], at) for name in part if name != "picture"}

        def either(measured: str, all_of_it: str) -> torch.Tensor:
            return torch.where(agreed, read[measured], read[all_of_it])

        depth = either("agreed", "depth").float()
        origin = torch.where(agreed, (depth > 0).to(torch.uint8) * MEASURED, read["origin"])
        predicted = (origin == PREDICTED) & left_out
        depth, origin = depth.masked_fill(predicted, 0), origin.masked_fill(predicted, 0)
        agree, through = (
            either(*names).masked_fill(depth == 0, 0)
            for names in (("agreed_agree", "agree"), ("agreed_through", "through"))
        )
        picture = (self.smooth(part["picture"], at).round() / 255).permute(0, 3, 1, 2)
        features = mending_features(
            self.other_light(picture, generator), depth, origin, read["correlation"].float() / 100, agree,
            through, read["surety"].float() / 100,
        )  # fmt: skip
        truth = read["exact_depth"].float()
        candidates = candidate_depths(torch.where(depth > 0, 1 / depth.clamp_min(1e-12), 0.0))
        return [features, likelihoods(candidates, truth), weights(candidates, truth), read["exact_ids"].int()]


def mending_features(picture, depth, origin, correlation, agree, through, surety) -> torch.Tensor:
    """Return `reconstruction.depth.mending.mending_features` of a batch (b, h, w); picture is (b, 3, h, w)."""
    known = depth > 0
    log = torch.where(known, depth.clamp_min(1e-9).log(), 0.0)
    half = AROUND_PX // 2
    sums = functional.pad(torch.stack([known.float(), log], 1), (half,) * 4, mode="reflect")
    # Means over rows, then over columns, times the window: sums.
    sums = functional.avg_pool2d(sums, (AROUND_PX, 1), 1)
    sums = functional.avg_pool2d(sums, (1, AROUND_PX), 1) * AROUND_PX**2
    beside = torch.where(known, log - sums[:, 1] / sums[:, 0].clamp_min(1), 0.0)
    middle = log.masked_fill(~known, math.nan).flatten(1).nanmedian(1).values.nan_to_num(0.0)
    measured, predicted = origin == MEASURED, origin == PREDICTED
    out = torch.empty((len(depth), FEATURES, *depth.shape[1:]), device=depth.device)
    out[:, :3] = picture - 0.5
    out[:, 3] = (4 * beside).clamp(-2, 2)
    out[:, 4] = (40 * beside).clamp(-2, 2)
    out[:, 5] = torch.where(known, (log - middle[:, None, None]).clamp(-1.5, 1.5), 0.0)
    for channel, mask in enumerate((measured, origin == COMPLETED, predicted), start=6):
        out[:, channel] = mask.float()
    out[:, 9] = torch.where(measured, correlation.clamp(0, 1), 0.0)
    out[:, 10] = (agree / MANY_VIEWS).clamp_max(1)
    out[:, 11] = (through / MANY_VIEWS).clamp_max(1)
    out[:, 12] = torch.where(predicted, surety, 0.0)
    return out


def _shifted(values: torch.Tensor, margin: int, dy: int, dx: int, h: int, w: int) -> torch.Tensor:
    return values[..., margin + dy : margin + dy + h, margin + dx : margin + dx + w]


def fit_slopes(rho: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the slopes (b, h, w) to the right and down of `reconstruction.depth.refine.fit_slopes`."""
    h, w = rho.shape[1:]
    # Outside of the picture nothing continues a surface.
    padded = functional.pad(rho, (_FIT_REACH,) * 4, value=math.inf)
    n, sx, sy, sr, sxx, syy, sxy, sxr, syr = (torch.zeros_like(rho) for _ in range(9))
    for b in range(-_FIT_REACH, _FIT_REACH + 1):
        for a in range(-_FIT_REACH, _FIT_REACH + 1):
            e = _shifted(padded, _FIT_REACH, b, a, h, w) - rho
            m = (e.abs() <= _JUMP * max(1, abs(a) + abs(b)) * rho).float()
            e = torch.where(m > 0, e, 0.0)
            n, sx, sy, sr = n + m, sx + a * m, sy + b * m, sr + e
            sxx, syy, sxy = sxx + a * a * m, syy + b * b * m, sxy + a * b * m
            sxr, syr = sxr + a * e, syr + b * e
    inv = 1 / n
    xx, yy, xy = sxx - sx * sx * inv, syy - sy * sy * inv, sxy - sx * sy * inv
    xr, yr = sxr - sx * sr * inv, syr - sy * sr * inv
    det = xx * yy - xy * xy
    scale = torch.where((n >= _FEW) & (det > 1), 1 / det, 0.0)
    return (xr * yy - yr * xy) * scale, (yr * xx - xr * xy) * scale


def candidate_depths(rho: torch.Tensor) -> torch.Tensor:
    """Return `depth.candidates.candidate_depths` (b, k, h, w) of inverse depths (b, h, w), 0 = unknown."""
    h, w = rho.shape[1:]
    gx, gy = fit_slopes(rho)
    sum_x, sum_y, n = (torch.zeros_like(rho) for _ in range(3))
    padded = functional.pad(torch.stack([rho, gx, gy]), (SLOPE_REACH,) * 4)
    for dy in range(-SLOPE_REACH, SLOPE_REACH + 1, SLOPE_STRIDE):
        for dx in range(-SLOPE_REACH, SLOPE_REACH + 1, SLOPE_STRIDE):
            there, ax, ay = _shifted(padded, SLOPE_REACH, dy, dx, h, w)
            m = ((there > 0) & ((there - rho - gx * dx - gy * dy).abs() < _JUMP * rho)).float()
            sum_x, sum_y, n = sum_x + ax * m, sum_y + ay * m, n + m
    known = rho > 0
    mean_x, mean_y = (
        torch.where(known, torch.where(n > 0, s / n.clamp_min(1), g), 0.0)
        for s, g in ((sum_x, gx), (sum_y, gy))
    )
    padded = functional.pad(torch.stack([rho, mean_x, mean_y]), (_FARTHEST,) * 4)
    out = []
    for dy, dx in _OFFSETS:
        r, ax, ay = _shifted(padded, _FARTHEST, dy, dx, h, w)
        there = r - ax * dx - ay * dy
        out.append(torch.where((r > 0) & ((there - r).abs() < _MOST_BENT * r), there, 0.0))
    return torch.stack(out, 1)


def likelihoods(candidates: torch.Tensor, truth: torch.Tensor) -> torch.Tensor:
    """Return the log likelihood (b, k + 1, h, w) of the true depth (b, h, w) under each candidate, "none" last."""
    each = -(candidates * truth[:, None] - 1).abs() / SPREAD
    each = torch.where(candidates > 0, each, MISSING)
    return torch.cat([each, torch.full_like(each[:, :1], NONE)], 1)


def weights(candidates: torch.Tensor, truth: torch.Tensor) -> torch.Tensor:
    """Return the weight (b, h, w) of each pixel: none without candidates, more beside steps of the true depth."""
    beside = near_steps(truth, BESIDE_PX)
    return (candidates > 0).any(1).float() * (1 + (BESIDE_WEIGHT - 1) * beside)
