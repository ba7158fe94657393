"""Self-calibration: estimate moving crop and rolling shutter together with poses, points and lens, in one adjustment.

A stabilizer moves the crop, so that every frame has a principal point of its own. A rolling shutter reads rows one
after the other, so that every row has a pose of its own. Left out, both bend the path and the focal length, and one
bends the estimate of the other. So all are unknowns of one bundle adjustment.

The offsets of the principal points have a normal prior whose spread is estimated with them (automatic relevance
determination, MacKay 1992): it falls to its least where the crop does not move.
"""

from dataclasses import dataclass, replace

import numpy as np

from reconstruction.poses.bundle import OF_FRAME, OFFSET, Bundle, Equations, Unknowns, losses

_FIRST_SPREAD_PX = 20.0
_LEAST_SPREAD_PX = 0.5  # the error of SIFT
_STEPS_BEFORE_SPREAD = 3  # with the first spread, so that the offsets leave zero
_AT_REST = (
    1e-6  # spread, pixels, and standard deviation of the readout time, seconds, of a camera without either
)
_STEPS = 40
_TOLERANCE = 1e-5  # of the loss of an observation
_DAMPING, _LESS, _MORE, _TRIES = 1e-4, 1 / 6, 8.0, 8  # of Levenberg-Marquardt


@dataclass(frozen=True)
class Calibration:
    """Poses, points, lens, principal points and readout time, and the spreads of their priors."""

    unknowns: Unknowns
    spread_px: float  # standard deviation of the offsets
    readout_sigma_s: float  # of the prior of the readout time

    def precision(self, cameras: int) -> np.ndarray:
        """Return the second derivative of the prior by each of the cameras' unknowns, (cameras,)."""
        out = np.zeros(cameras)
        out[_offsets(self.unknowns)] = self.spread_px**-2
        out[-1] = self.readout_sigma_s**-2
        return out

    def slope(self, cameras: int) -> np.ndarray:
        """Return the first derivative of the prior by each of the cameras' unknowns, (cameras,)."""
        out = np.zeros(cameras)
        out[_offsets(self.unknowns)] = self.unknowns.offset
        out[-1] = self.unknowns.readout_s
        return out * self.precision(cameras)

    def loss(self, error: np.ndarray) -> float:
        """Return the negative logarithm of the posterior for errors (k, 2), up to a constant."""
        offset = self.unknowns.offset
        prior = 0.5 * ((offset / self.spread_px) ** 2).sum() + offset.size * np.log(self.spread_px)
        prior += 0.5 * (self.unknowns.readout_s / self.readout_sigma_s) ** 2
        return float(losses(error).sum() + prior)


def self_calibrate(bundle: Bundle, *, at_rest: bool = False) -> Calibration:
    """Adjust a bundle by Levenberg-Marquardt steps on the reduced camera system, until its loss no longer falls.

    Args:
        bundle: observations and first values.
        at_rest: the crop does not move, and rows are read at once.
    """
    now = Calibration(bundle.start, *((_AT_REST, _AT_REST) if at_rest else (_FIRST_SPREAD_PX, np.inf)))
    damping, linear = _DAMPING, bundle.linearized(now.unknowns)
    loss = now.loss(linear.error)
    for step in range(_STEPS):
        equations = Equations.of(linear, len(bundle.rows), len(bundle.point_ids))
        for _ in range(_TRIES):
            trial = replace(now, unknowns=bundle.stepped(now.unknowns, *_step(equations, now, damping)))
            error = bundle.errors(trial.unknowns)
            if trial.loss(error) < loss:
                break
            damping *= _MORE
        else:
            break
        if step >= _STEPS_BEFORE_SPREAD and not at_rest:
            spread = float(np.sqrt((trial.unknowns.offset**2).mean()))
            trial = replace(trial, spread_px=max(_LEAST_SPREAD_PX, spread))
        before, loss = loss, trial.loss(error)
        now, damping = trial, damping * _LESS
        if step > _STEPS_BEFORE_SPREAD and before - loss < _TOLERANCE * len(error):
            break
        linear = bundle.linearized(now.unknowns)
    return now


def _step(equations: Equations, now: Calibration, damping: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the damped step (c,) of the cameras and (m, 3) of the points, which are eliminated first."""
    matrix, gradient, inverse = equations.reduced(damping)
    count = len(gradient)
    matrix = matrix + np.diag(damping * np.diag(equations.cameras) + now.precision(count) + 1e-9)
    step = -np.linalg.solve(matrix, gradient + now.slope(count))
    rest = (equations.of_points + equations.mixed.T @ step).reshape(-1, 3)
    return step, -np.einsum("mij,mj->mi", inverse, rest)


def _offsets(unknowns: Unknowns) -> np.ndarray:
    """Return where the offsets (n, 2) stand among the cameras' unknowns."""
    return OF_FRAME * np.arange(len(unknowns.turn))[:, None] + OFFSET
