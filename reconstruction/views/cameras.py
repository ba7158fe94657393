"""Upright cameras: looking at a point, stepping around it, and the square camera that views are taken with."""

import math

import numpy as np

from reconstruction.core.types import Camera
from registry.geometry import matrix_from_quat, quat_from_matrix, rigid

UP = np.array([0.0, 0.0, 1.0])


def square_camera(side_px: int, fov_deg: float) -> Camera:
    """Return a square pinhole camera."""
    focal = 0.5 * side_px / math.tan(math.radians(0.5 * fov_deg))
    return Camera(side_px, side_px, focal, focal, 0.5 * side_px, 0.5 * side_px)


def upright(forward: np.ndarray, max_pitch_deg: float, fallback: np.ndarray | None = None) -> np.ndarray:
    """Return the rotation (3, 3) of a camera that looks along `forward` (3,), without roll.

    Args:
        forward: any length; its pitch is limited.
        max_pitch_deg: of a view up or down.
        fallback: horizontal direction where `forward` is vertical.
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
    """Return the pose (4, 4) of an upright camera at `eye` (3,) that looks at `point` (3,)."""
    return rigid(upright(np.asarray(point) - np.asarray(eye), max_pitch_deg), np.asarray(eye, np.float64))


def moved(pose: np.ndarray, step: np.ndarray, distance: float, max_pitch_deg: float) -> np.ndarray:
    """Return the pose after a step in the coordinates of `step_gradient`; the camera stays upright.

    Position and quaternion are what moves; the quaternion is brought back to one without roll.

    Args:
        pose: (4, 4) world_from_camera.
        step: (5,) right and down around the point ahead (relative to `distance`), ahead (likewise), then turning right
            and down (radians).
        distance: of the point ahead, metres.
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
    """Carry the derivative by world_from_camera exp(xi) (6,) to the steps (5,) of `moved`.

    Moving sideways turns the camera so that the point ahead stays ahead: without it, a camera that looks along a step
    loses its target.
    """
    moving, turning = pose_gradient[:3], pose_gradient[3:]
    return np.array(
        [
            distance * moving[0] - turning[1],
            distance * moving[1] + turning[0],
            distance * moving[2],
            turning[1],
            -turning[0],
        ]
    )
