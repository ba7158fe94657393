"""Align the estimated world to the true one by camera centers (Umeyama 1991) and measure the camera errors."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from registry.errors import UsageError
from registry.geometry import split_similarity, transform_points, umeyama

_MIN_CAMERAS = 3


@dataclass(frozen=True)
class Alignment:
    """A similarity from the estimated to the true world, and the camera residuals after it."""

    true_from_estimated: np.ndarray  # float64 (4, 4), scale inside the 3x3 block
    indices: np.ndarray  # int32 (n,) video frames with both poses
    center_errors_m: np.ndarray  # float64 (n,) in true metres
    rotation_errors_deg: np.ndarray  # float64 (n,)
    tilt_deg: float  # angle between the estimated and the true up direction

    @property
    def scale(self) -> float:
        """Scale of the similarity: true metres per estimated metre."""
        return split_similarity(self.true_from_estimated)[0]

    @property
    def ate_cm(self) -> float:
        """Absolute trajectory error: RMSE of the camera centers."""
        return float(np.sqrt((self.center_errors_m**2).mean()) * 100)

    def to_true(self, points: np.ndarray) -> np.ndarray:
        """Transform points (n, 3) from the estimated to the true world."""
        return transform_points(self.true_from_estimated, points)

    def pose_to_true(self, world_from_camera: np.ndarray) -> np.ndarray:
        """Transform a pose world_from_camera (4, 4) to the true world; the result is rigid."""
        _, rotation, _ = split_similarity(self.true_from_estimated)
        out = np.eye(4)
        out[:3, :3] = rotation @ world_from_camera[:3, :3]
        out[:3, 3] = transform_points(self.true_from_estimated, world_from_camera[None, :3, 3])[0]
        return out


def align(
    estimated: Mapping[int, np.ndarray], true: Mapping[int, np.ndarray], up: np.ndarray | None = None
) -> Alignment:
    """Estimate the similarity from the camera centers of all frames with both poses.

    Args:
        estimated: video frame -> world_from_camera (4, 4) in the estimated world (+z up).
        true: the same in the true world.
        up: (3,) unit vector against gravity in the true world; None: +z.

    Raises:
        UsageError: fewer than three common frames, or collinear camera centers, which leave the rotation undefined.
    """
    indices = np.array(sorted(set(estimated) & set(true)), np.int32)
    if len(indices) < _MIN_CAMERAS:
        raise UsageError(
            f"evaluate: only {len(indices)} frames have both an estimated and a true camera, at least "
            f"{_MIN_CAMERAS} are needed. Is this the ground truth of the same video?"
        )
    a = np.array([estimated[int(i)] for i in indices])
    b = np.array([true[int(i)] for i in indices])
    spread = np.linalg.svd(b[:, :3, 3] - b[:, :3, 3].mean(0), compute_uv=False)
    if spread[1] < 1e-6 * max(spread[0], 1e-12):
        raise UsageError(
            "evaluate: the true cameras lie on one line, so the rotation of the alignment is undefined"
        )
    matrix = umeyama(a[:, :3, 3], b[:, :3, 3])
    _, rotation, _ = split_similarity(matrix)
    errors = np.linalg.norm(transform_points(matrix, a[:, :3, 3]) - b[:, :3, 3], axis=1)
    relative = np.swapaxes(rotation @ a[:, :3, :3], 1, 2) @ b[:, :3, :3]
    tilt = _angle_deg(rotation[:, 2], np.array([0.0, 0.0, 1.0]) if up is None else up)
    return Alignment(matrix, indices, errors, _rotation_angles_deg(relative), tilt)


def _rotation_angles_deg(rotations: np.ndarray) -> np.ndarray:
    # The skew-symmetric part is accurate for small angles; the arc cosine of the trace is not.
    skew = np.stack(
        [
            rotations[:, 2, 1] - rotations[:, 1, 2],
            rotations[:, 0, 2] - rotations[:, 2, 0],
            rotations[:, 1, 0] - rotations[:, 0, 1],
        ],
        axis=1,
    )
    return np.degrees(np.arctan2(np.linalg.norm(skew, axis=1), np.trace(rotations, axis1=1, axis2=2) - 1))


def _angle_deg(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)))
