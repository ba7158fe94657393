"""Stabilized films: a crop that moves over the sensor gives every frame a principal point of its own.

Resection of single frames with their principal point alternates with bundle adjustment of the points moved by it. The
offsets have mean zero, as their mean cannot be told from the focal length's own center.
"""

from pathlib import Path

import numpy as np

from reconstruction.core.progress import Progress
from reconstruction.poses.colmap_types import ColmapCamera, Reconstruction
from reconstruction.poses.mapping import poses_of
from reconstruction.poses.observations import Observations, project, thinned
from reconstruction.poses.refine import LOSS_SCALE_PX, bundle_adjust

# Of the cost, by the first round: between films of two generated rooms without a moving crop, also with a readout of
# 20 ms, and with one that moves by 1 % of the longer side.
_LEAST_GAIN = 0.05
_LEAST_FURTHER_GAIN = 0.01  # of the cost, by one more round
_MOST_ROUNDS = 8
_RESECTION_STEPS = 8
_PRIOR_PX = 1e3  # standard deviation of an offset: keeps frames with few points solvable


def correct_moving_crop(
    model: Reconstruction, work_dir: Path, progress: Progress
) -> dict[int, np.ndarray] | None:
    """Estimate the principal point of each frame of a model and adjust the model to it, in place.

    Args:
        model: all frames share one camera; their observed points are moved to where it sees them.
        work_dir: folder for a copy of the model.
        progress: receives a note.

    Returns:
        Offset (2,) in pixels of the principal point of each frame by its row; None where the crop does not move.
    """
    thin = thinned(model, work_dir / "moving_crop")
    observations = Observations(thin)
    bundle_adjust(thin)
    offsets = {row: np.zeros(2) for row in observations.rows}
    costs = [observations.cost()]
    while len(costs) <= _MOST_ROUNDS:
        offsets = _resected(observations, offsets)
        observations.place(offsets)
        bundle_adjust(thin)
        costs.append(observations.cost())
        gain = 1 - costs[-1] / max(costs[-2], 1e-12)
        if gain < (_LEAST_GAIN if len(costs) == 2 else _LEAST_FURTHER_GAIN):
            break
    if 1 - costs[1] / max(costs[0], 1e-12) < _LEAST_GAIN:
        return None
    Observations(model).place(offsets)
    bundle_adjust(model)
    model.update_point_3d_errors()
    largest = max(float(np.linalg.norm(offset)) for offset in offsets.values())
    progress.note(
        f"poses: the film was stabilized by a crop that moves by up to {largest:.0f} pixels, corrected; a film "
        "without stabilization is better"
    )
    return offsets


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
    for _ in range(_RESECTION_STEPS):
        moved = points @ turn.T + shift
        error = project(camera, moved) + offset - pixels
        jacobian = _jacobian(camera, moved)
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


def _jacobian(camera: ColmapCamera, points: np.ndarray) -> np.ndarray:
    """Return the derivative (k, 2, 8) of pixels by rotation, translation and principal point."""
    far = 1e-4 * float(np.abs(points[:, 2]).mean())
    by_point = np.stack(
        [(project(camera, points + d) - project(camera, points - d)) / (2 * far) for d in far * np.eye(3)], -1
    )
    x, y, z = points.T
    none = np.zeros(len(points))
    by_turn = np.stack([none, z, -y, -z, none, x, y, -x, none], -1).reshape(-1, 3, 3)
    own = np.broadcast_to(np.eye(2), (len(points), 2, 2))
    return np.concatenate([by_point @ by_turn, by_point, own], axis=2)


def _resected(observations: Observations, offsets: dict[int, np.ndarray]) -> dict[int, np.ndarray]:
    """Return the offsets after one resection of each frame, with mean zero."""
    poses = poses_of(observations.model)
    out = {
        row: resect(
            observations.camera,
            observations.points_in_camera(row, poses[row]),
            observations.pixels[row],
            offsets[row],
        )
        for row in observations.rows
    }
    mean = np.mean(list(out.values()), axis=0)
    return {row: offset - mean for row, offset in out.items()}
