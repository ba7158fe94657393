"""Sparse Adam over packed Gaussians, the statistics for densification, pruning and splitting."""

import math
from dataclasses import dataclass

import numpy as np

from reconstruction.gaussians.config import GaussiansConfig
from reconstruction.gaussians.threads import run_over
from registry.geometry import matrix_from_quat

BETA1, BETA2, EPSILON = 0.9, 0.99, 1e-15  # rows get few steps, hence a shorter memory than the usual 0.999


class Adam:
    """Adam for an array whose rows are updated one at a time (exposures, poses)."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        self._first, self._second = np.zeros(shape), np.zeros(shape)
        self._visits = np.zeros(shape[0], np.int64)

    def step(self, row: int, gradient: np.ndarray, rate: float) -> np.ndarray:
        """Return the change of one row for its gradient."""
        self._visits[row] += 1
        n = self._visits[row]
        self._first[row] = BETA1 * self._first[row] + (1 - BETA1) * gradient
        self._second[row] = BETA2 * self._second[row] + (1 - BETA2) * gradient**2
        a, b = self._first[row] / (1 - BETA1**n), self._second[row] / (1 - BETA2**n)
        return -rate * a / (np.sqrt(b) + EPSILON)


@dataclass
class SplatState:
    """Parameters under optimization, moments of Adam, and statistics since the last densification."""

    parameters: np.ndarray  # float32 (n, 13)
    first: np.ndarray  # float32 (n, 13) first moments
    second: np.ndarray  # float32 (n, 13) second moments
    visits: np.ndarray  # int32 (n,) Adam steps taken
    seen: np.ndarray  # int32 (n,) number of frames that drew it
    contribution: np.ndarray  # float32 (n,) sum of alpha T over their pixels
    error: np.ndarray  # float32 (n,) sum of alpha T times pixel error
    radius_px: np.ndarray  # float32 (n,) largest standard deviation in an image

    @classmethod
    def start(cls, parameters: np.ndarray) -> "SplatState":
        """Return the state of new parameters (n, 13)."""
        n = len(parameters)
        return cls(
            np.ascontiguousarray(parameters, np.float32), np.zeros((n, 13), np.float32),
            np.zeros((n, 13), np.float32), np.zeros(n, np.int32), np.zeros(n, np.int32), np.zeros(n, np.float32),
            np.zeros(n, np.float32), np.zeros(n, np.float32),
        )  # fmt: skip

    def __len__(self) -> int:
        """Return the number of Gaussians."""
        return len(self.parameters)

    def update(self, gradients: np.ndarray, rows: np.ndarray, rates: np.ndarray, limits: np.ndarray) -> None:
        """Take one Adam step on rows (k,), with rates (13,); clamp log scales to limits (2,)."""
        from reconstruction.gaussians import adam_kernel

        run_over(
            len(rows), adam_kernel.adam_rows, self.parameters, gradients, self.first, self.second, self.visits, rows,
            rates, BETA1, BETA2, EPSILON,
        )  # fmt: skip
        scales = self.parameters[:, 7:9]
        np.clip(scales, limits[0], limits[1], out=scales)

    def tally(
        self, rows: np.ndarray, depths: np.ndarray, focal: float, contribution: np.ndarray, error: np.ndarray
    ) -> None:
        """Add the statistics of a frame: rows (k,) seen at depths (k,); contribution and error (n,)."""
        self.seen[rows] += 1
        self.contribution += contribution
        self.error += error
        radius = np.exp(self.parameters[rows, 7:9].max(axis=1)) * focal / depths
        self.radius_px[rows] = np.maximum(self.radius_px[rows], radius)

    def forget_tally(self) -> None:
        """Reset the statistics."""
        for counter in (self.seen, self.contribution, self.error, self.radius_px):
            counter[:] = 0

    def keep(self, mask: np.ndarray) -> None:
        """Drop the rows where the mask is False."""
        for name in self.__dataclass_fields__:
            setattr(self, name, np.ascontiguousarray(getattr(self, name)[mask]))

    def append(self, parameters: np.ndarray) -> None:
        """Append parameters (k, 13) with empty moments and statistics."""
        new = SplatState.start(parameters)
        for name in self.__dataclass_fields__:
            setattr(self, name, np.concatenate([getattr(self, name), getattr(new, name)]))


def rates_of(config: GaussiansConfig, median_depth: float, share_done: float) -> np.ndarray:
    """Return the Adam rate (13,) of every column after a share of the training."""
    rates = np.empty(13)
    rates[:3], rates[3:7] = config.mean_rate * median_depth, config.quaternion_rate
    rates[7:9], rates[9], rates[10:] = config.scale_rate, config.opacity_rate, config.color_rate
    return rates * config.final_rate**share_done


def prune(state: SplatState, config: GaussiansConfig) -> int:
    """Remove Gaussians that are nearly transparent, nearly hidden or not finite; return their number."""
    opacity = 1.0 / (1.0 + np.exp(-state.parameters[:, 9]))
    hidden = (state.seen >= 3) & (state.contribution < 0.02 * state.seen)
    keep = (opacity >= config.prune_opacity) & ~hidden & np.isfinite(state.parameters).all(axis=1)
    state.keep(keep)
    return int((~keep).sum())


def split(state: SplatState, config: GaussiansConfig) -> int:
    """Split the Gaussians with the largest error per view in two along their longer axis; return their number.

    Error instead of position gradient selects them (Rota Bulo et al., "Revising Densification in Gaussian Splatting",
    2024). Splats with a standard deviation below 0.6 pixels are not split.
    """
    room = min(config.max_gaussians - len(state), int(config.densify_growth * len(state)))
    score = state.error / np.maximum(state.seen, 1)
    score[(state.radius_px < 0.6) | (state.seen == 0)] = 0
    if room <= 0:
        return 0
    rows = np.argsort(-score, kind="stable")[:room]
    rows = np.sort(rows[score[rows] > 0])
    if len(rows) == 0:
        return 0
    p = state.parameters[rows]
    longer = np.argmax(p[:, 7:9], axis=1)
    every = np.arange(len(rows))
    sigma = np.exp(p[every, 7 + longer])
    axis = matrix_from_quat(p[:, 3:7])[every, :, longer]
    one, other = p.copy(), p.copy()
    # Two Gaussians of 0.63 sigma at +-0.77 sigma have the mean and variance of the original.
    one[:, :3] += 0.77 * sigma[:, None] * axis
    other[:, :3] -= 0.77 * sigma[:, None] * axis
    for half in (one, other):
        half[every, 7 + longer] += np.float32(math.log(0.63))
    state.parameters[rows] = one
    for moments in (state.first, state.second):
        moments[rows] = 0
    state.visits[rows] = 0
    state.append(other)
    return len(rows)
