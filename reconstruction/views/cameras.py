"""Poses of upright cameras (no roll): look-at, steps of the optimization, and the square camera of views."""

import math

import numpy as np

from reconstruction.core.types import Camera
from registry.geometry import matrix_from_quat, quat_from_matrix, rigid

UP = np.array([0.0, 0.0, 1.0])


def square_camera(side_px: int, fov_deg: float) -> Camera:
    """Return a pinhole camera with a square image and a field of view in degrees."""
    focal = 0.5 * side_px / math.tan(math.radians(0.5 * fov_deg))
    return Camera(side_px, side_px, focal, focal, 0.5 * side_px, 0.5 * side_px)


def upright(forward: np.ndarray, max_pitch_deg: float, fallback: np.ndarray | None = None) -> np.ndarray:
    """Return world_from_camera rotation (3, 3) of a camera that looks along `forward`, without roll.

    Args:
        forward: (3,) of any length, world space; its pitch is clamped.
        max_pitch_deg: largest pitch up or down.
        fallback: (3,) horizontal direction if `forward` is vertical.
    """
    forward = np.asarray(forward, np.float64)
    flat = forward[:2]
    length = float(np.linalg.norm(flat))
    if length < 1e-9:
        flat = np.array([1.0, 0.0]) if fallback is None else np.asarray(fallback, np.float64)[:2]
        length = max(float(np.linalg.norm(flat)), 1e-12)
        pitch = math.copysign(0.5 * math.pi, forward[2])
    else:
        pitch = math.atan2(forward[2], length)
    limit = math.radians(max_pitch_deg)
    pitch = min(max(pitch, -limit), limit)
    ahead = np.append(math.cos(pitch) * flat / length, math.sin(pitch))
    right = np.cross(ahead, UP)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(ahead, right), ahead], axis=1)


def look_at(eye: np.ndarray, point: np.ndarray, max_pitch_deg: float) -> np.ndarray:
    """Return world_from_camera (4, 4) of an upright camera at `eye` (3,) that looks at `point` (3,)."""
    return rigid(upright(np.asarray(point) - np.asarray(eye), max_pitch_deg), np.asarray(eye, np.float64))


def moved(pose: np.ndarray, step: np.ndarray, distance: float, max_pitch_deg: float) -> np.ndarray:
    """Return the pose after a step; roll is removed from the new quaternion.

    Args:
        pose: (4, 4) world_from_camera.
        step: (5,) orbit right and down around the point ahead, and dolly ahead, all three relative to `distance`; then
            pan right and tilt down (radians).
        distance: to the point ahead, metres.
        max_pitch_deg: as in `upright`.
    """
    rotation = pose[:3, :3]
    turn = np.array([step[1] - step[4], step[3] - step[0], 0.0])  # about the camera's x and y
    angle = float(np.linalg.norm(turn))
    axis = turn / max(angle, 1e-12)
    delta = np.append(math.cos(0.5 * angle), math.sin(0.5 * angle) * axis)
    turned = rotation @ matrix_from_quat(delta)
    rotation_after = matrix_from_quat(quat_from_matrix(upright(turned[:, 2], max_pitch_deg, rotation[:, 2])))
    return rigid(rotation_after, pose[:3, 3] + rotation @ (distance * step[:3]))


def step_gradient(pose_gradient: np.ndarray, distance: float) -> np.ndarray:
    """Transform the gradient (6,) by world_from_camera exp(xi) to that (5,) by the step of `moved`.

    Sideways steps also rotate the camera, so that the point ahead stays in the center of the view.
    """
    (x, y, z), turning = pose_gradient[:3], pose_gradient[3:]
    orbit = (distance * x - turning[1], distance * y + turning[0], distance * z)
    return np.array([*orbit, turning[1], -turning[0]])
