"""Search for the best viewpoint: gradient descent on the pose inside observed free space."""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from reconstruction.views.cameras import moved, step_gradient
from reconstruction.views.clearance import Clearance
from reconstruction.views.config import AvoConfig

if TYPE_CHECKING:
    from reconstruction.views.objective import Objective, Value

_DECAYS, _EPSILON = (0.8, 0.95), 1e-8  # of Adam; decays for a search of few steps
_LAST_RATE = 0.1  # final step size relative to the first
_PUSHES = 12  # attempts to move a camera into free space
_PATIENCE = 12  # steps without improvement after which the search stops


@dataclass(frozen=True)
class Found:
    """A viewpoint and its value."""

    pose: np.ndarray  # float64 (4, 4) world_from_camera
    value: "Value"  # of the objective, without the clearance penalty
    loss: float  # with the clearance penalty
    steps: int  # step of the schedule at which it was found


@dataclass(frozen=True)
class Search:
    """Gradient descent from start poses; see `AvoConfig` for the weights."""

    objective: "Objective"
    clearance: Clearance
    distance_m: float  # target distance d
    depth_weight: float  # lambda
    config: AvoConfig

    def loss_of_place(self, eye: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the clearance penalty of a camera position (3,) and its gradient (3,)."""
        wanted = self.config.clearance_m
        clearance, slope = self.clearance.with_gradient(eye)
        lacking = max(wanted - clearance, 0.0) / wanted
        weight = self.config.free_weight
        return weight * lacking**2, -2.0 * weight * lacking / wanted * slope

    def best_of(self, starts: np.ndarray, worth: np.ndarray) -> Found | None:
        """Optimize from several starts: a third of the steps from each, the rest from the best one.

        Args:
            starts: (k, 4, 4) poses.
            worth: (2, m) as in `Objective.evaluate`.

        Returns:
            The best pose on the way; None if no start is near free space.
        """
        scouting = self.config.steps // 3 if len(starts) > 1 else self.config.steps
        tried = (self.descend(start, worth, 0, scouting) for start in starts)
        found = [one for one in tried if one is not None]
        if not found:
            return None
        best = min(found, key=lambda one: one.loss)
        if scouting == self.config.steps:
            return best
        further = self.descend(best.pose, worth, scouting, self.config.steps)
        return further if further is not None and further.loss < best.loss else best

    def descend(
        self, start: np.ndarray, worth: np.ndarray, first: int = 0, last: int | None = None
    ) -> Found | None:
        """Optimize from one start with Adam; return the best pose on the way, None if the start is not near free space.

        Args:
            start: (4, 4) pose.
            worth: (2, m) as in `Objective.evaluate`.
            first: first step of the rate schedule.
            last: last step of the rate schedule; None is that of the config.
        """
        config = self.config
        pose = self._into_free_space(start)
        if pose is None:
            return None
        best: Found | None = None
        mean, spread, stale = np.zeros(5), np.zeros(5), 0
        for number, step in enumerate(range(first, (config.steps if last is None else last) + 1), start=1):
            value = self.objective.evaluate(pose, worth, self.distance_m, self.depth_weight)
            penalty, slope = self.loss_of_place(pose[:3, 3])
            loss = value.loss + penalty
            stale += 1
            if best is None or loss < best.loss - 1e-6:
                best, stale = Found(pose, value, loss, step), 0
            if stale > _PATIENCE:
                break
            by_pose = value.gradient.copy()
            by_pose[:3] += pose[:3, :3].T @ slope
            ahead = value.depth_m or self.distance_m
            gradient = step_gradient(by_pose, ahead)
            mean = _DECAYS[0] * mean + (1 - _DECAYS[0]) * gradient
            spread = _DECAYS[1] * spread + (1 - _DECAYS[1]) * gradient**2
            share = step / max(config.steps, 1)
            rate = config.rate * (_LAST_RATE + (1 - _LAST_RATE) * 0.5 * (1 + math.cos(math.pi * share)))
            scale = np.sqrt(spread / (1 - _DECAYS[1] ** number)) + _EPSILON
            unit = (mean / (1 - _DECAYS[0] ** number)) / scale
            size = rate * np.array(
                [1.0, 1.0, 1.0, 0.3, 0.3]
            )  # pan and tilt change the image faster than orbiting
            after = self._into_free_space(moved(pose, -size * unit, ahead, config.max_pitch_deg))
            if after is None:
                mean[:3] = 0.0
                after = moved(pose, -size * unit * np.array([0, 0, 0, 1, 1]), ahead, config.max_pitch_deg)
            pose = after
        return best

    def _into_free_space(self, pose: np.ndarray) -> np.ndarray | None:
        """Return the pose moved along the clearance gradient until the camera is free; None if that fails."""
        least = self.config.min_clearance_m
        eye = pose[:3, 3].copy()
        for _ in range(_PUSHES):
            clearance, slope = self.clearance.with_gradient(eye)
            if clearance >= least:
                out = pose.copy()
                out[:3, 3] = eye
                return out
            eye += slope / max(float(np.linalg.norm(slope)), 1e-9) * max(least - clearance, 0.01)
        return None
