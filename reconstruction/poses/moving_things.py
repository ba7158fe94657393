"""Find what moves before the camera, and leave its points out of a model: somebody who stays in view bends the path.

The points fall into clusters. If one of them moves, the path is a compromise between it and the rest, and without it
the rest fits better. How much better follows from the normal equations at the optimum: with S and g the reduced camera
system and gradient of the rest, one Gauss-Newton step lowers its loss by g' S^-1 g / 2 (Cook, Detection of influential
observation in linear regression, 1977).
"""

from dataclasses import dataclass

import numpy as np
from scipy.cluster.vq import kmeans2

from reconstruction.core.types import FrameSet
from reconstruction.poses.bundle import Bundle, Equations, Linear, Unknowns
from reconstruction.poses.colmap_types import Reconstruction
from reconstruction.poses.config import PosesConfig
from reconstruction.poses.refine import bundle_adjust, drop_weak_frames, filter_points, keep_largest_part
from reconstruction.poses.self_calibration import Calibration, self_calibrate
from registry.geometry import transform_points, umeyama

# Largest influence of a cluster, with moving crop and rolling shutter estimated. It was .5 to 3.5 in 50 films where all
# rests (kitchen, bench, generated ones), 3.1 to 19 in eight of nine where somebody stays in view, and 1.1 in the ninth,
# whose poses are right. What rests loses nothing but time by being looked at.
MOVING = 2.5
# The same without these two, of what is left: where it agrees, and where nothing more is to be found (.4 to 1.1 there).
_AGREES, _DONE = 2.0, 1.2
_CLUSTERS = (6, 12, 24)  # sizes of what may move are not known
_LEAST_POINTS = 10  # of a cluster
_MOST_SHARE = 0.4  # of the points: what rests is the larger part
# Share of the largest gain from which the influence decides: that of small clusters varies by chance.
_NEAR_LARGEST = 0.5
_ROUNDS = 6
_GAUGE = 1e-6  # share of the diagonal, added: position, turn and scale of the whole are free


@dataclass(frozen=True)
class Cluster:
    """Some of the points of a model: those nearest to one of several centers."""

    middle: np.ndarray  # float64 (3,) of the cameras
    unit: float  # median distance of the points from it
    centers: np.ndarray  # float64 (c, 3) as `_spread` places them
    number: int
    influence: float
    """How much better an observation of the rest fits without one of these, over what chance gives: about 1 at rest."""
    gain: float  # of the loss of the rest without this cluster
    share: float  # of the observations
    bend: float
    """RMSE of the camera centers before against after that Gauss-Newton step, as a share of the extent of the path."""

    def points_of(self, model: Reconstruction) -> list[int]:
        """Return the ids of the points of a model that are in this cluster."""
        ids = sorted(model.point3D_ids())
        places = np.array([model.point3D(i).xyz for i in ids]).reshape(-1, 3)
        away = _spread(places - self.middle, self.unit)[:, None] - self.centers
        nearest = (away**2).sum(2).argmin(1)
        return [ids[k] for k in np.flatnonzero(nearest == self.number)]


def clusters(bundle: Bundle, calibration: Calibration) -> list[Cluster]:
    """Return clusters of the points of a bundle that was adjusted, of several sizes, with their influence."""
    at = calibration.unknowns
    linear = bundle.linearized(at)
    middle = at.centers.mean(0)
    unit = float(np.median(np.linalg.norm(at.points - middle, axis=1)))
    places = _spread(at.points - middle, unit)
    matrix, gradient = _system(linear, at, np.arange(len(at.points)))
    gradient = gradient + calibration.slope(len(gradient))
    ridge = np.diag(_GAUGE * np.diag(matrix) + calibration.precision(len(gradient)) + 1e-9)
    observations = np.bincount(linear.point, minlength=len(at.points))
    chance = float(linear.losses().mean()) * len(gradient) / len(linear.error)
    out = []
    for count in (c for c in _CLUSTERS if c <= len(places)):
        centers, label = kmeans2(places, count, minit="++", rng=np.random.default_rng(0))
        for number in range(count):
            own = np.flatnonzero(label == number)
            if len(own) < _LEAST_POINTS or len(own) == len(at.points):
                continue
            less, pull = _system(linear, at, own)
            rest = gradient - pull
            step = -np.linalg.solve(matrix - less + ridge, rest)
            gain = -0.5 * float(rest @ step)
            seen = int(observations[own].sum())
            influence = gain / max(seen * chance, 1e-12)
            bend = _bend(at.centers, bundle.stepped(at, step, np.zeros_like(at.points)).centers)
            out.append(
                Cluster(middle, unit, centers, number, influence, gain, seen / len(linear.error), bend)
            )
    return out


def without_moving_things(
    model: Reconstruction, frames: FrameSet, config: PosesConfig
) -> Reconstruction | None:
    """Return an adjusted copy of a model without the points of what moves; None if no choice leaves one that agrees.

    Args:
        model: all frames share one camera; stays unchanged.
        frames: ordered.
        config: which points are outliers.
    """
    import pycolmap

    rest, agreeing = pycolmap.Reconstruction(model), None
    for _ in range(_ROUNDS):
        bundle = Bundle(rest, frames.times_s, frames.quarter_turns)
        found = clusters(bundle, self_calibrate(bundle, at_rest=True))
        influence = max((c.influence for c in found), default=0.0)
        if influence < _AGREES:
            agreeing = pycolmap.Reconstruction(rest)
        likely = [c for c in found if c.share < _MOST_SHARE]
        likely = [c for c in likely if c.gain >= _NEAR_LARGEST * max(f.gain for f in likely)]
        if influence < _DONE or not likely:
            break
        for point_id in max(likely, key=lambda c: c.influence).points_of(rest):
            rest.delete_point3D(point_id)
        bundle_adjust(rest)
        filter_points(rest, config.max_point_error_px, 2)
        drop_weak_frames(rest)
        keep_largest_part(rest)
        if rest.num_points3D() < (1 - _MOST_SHARE) * model.num_points3D():
            break
    return agreeing


def _spread(offsets: np.ndarray, unit: float) -> np.ndarray:
    """Return offsets (m, 3) with their lengths as logarithms, so that near and far count alike."""
    length = np.maximum(np.linalg.norm(offsets, axis=1, keepdims=True), 1e-12)
    return offsets / length * np.log1p(length / unit)


def _bend(centers: np.ndarray, moved: np.ndarray) -> float:
    """Return the RMSE of moved camera centers (n, 3) after alignment by a similarity, over the extent of the path."""
    off = transform_points(umeyama(moved, centers), moved) - centers
    extent = float(np.linalg.norm(np.ptp(centers, axis=0)))
    return float(np.sqrt((off**2).sum(1).mean())) / max(extent, 1e-12)


def _system(linear: Linear, at: Unknowns, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the reduced camera system of some points: matrix (c, c) and gradient (c,)."""
    return Equations.of(linear.of(points), len(at.turn), len(points)).reduced()[:2]
