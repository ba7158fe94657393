"""Resection of a frame whose principal point is its own: estimate it beside the pose, from points with known places."""

import numpy as np

from reconstruction.poses.colmap_types import ColmapCamera
from reconstruction.poses.observations import derivatives, project
from reconstruction.poses.refine import LOSS_SCALE_PX

_STEPS = 8
_PRIOR_PX = 1e3  # standard deviation of an offset: keeps frames with few points solvable


def resect(camera: ColmapCamera, points: np.ndarray, pixels: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Estimate the principal point of one frame beside its pose, by robust Gauss-Newton steps.

    Args:
        camera: of the film.
        points: (k, 3) in camera space of the present pose.
        pixels: (k, 2) where the frame shows them.
        offset: (2,) of the principal point, to begin with.

    Returns:
        The offset (2,) in pixels.
    """
    from scipy.spatial.transform import Rotation

    turn, shift = np.eye(3), np.zeros(3)
    prior = np.diag([*np.full(6, 1e-9), *np.full(2, _PRIOR_PX**-2)])
    for _ in range(_STEPS):
        moved = points @ turn.T + shift
        error = project(camera, moved) + offset - pixels
        jacobian = derivatives(camera, moved)
        weight = 1 / (LOSS_SCALE_PX**2 + (error**2).sum(1))
        # Not points so near the camera's plane that a step of the derivative puts them behind it.
        used = np.isfinite(weight) & np.isfinite(jacobian).all(axis=(1, 2))
        jacobian, error, weight = jacobian[used], error[used], weight[used]
        normal = np.einsum("k,kij,kil->jl", weight, jacobian, jacobian)
        right = np.einsum("k,kij,ki->j", weight, jacobian, error)
        step = -np.linalg.solve(normal + prior + 1e-9 * np.diag(np.diag(normal)), right)
        by = Rotation.from_rotvec(step[:3]).as_matrix()
        turn, shift, offset = by @ turn, by @ shift + step[3:6], offset + step[6:]
    return offset
