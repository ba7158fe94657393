"""Format numbers and rotations for XML without losing precision."""

from collections.abc import Iterable

import numpy as np


def text_of(values: Iterable[float]) -> str:
    """Return numbers separated by spaces, with all digits of a float64; -0.0 becomes 0.0."""
    return " ".join(repr(float(value) + 0.0) for value in values)


def roll_pitch_yaw(rotation: np.ndarray) -> tuple[float, float, float]:
    """Convert a rotation (3, 3) to URDF's fixed-axis angles in radians: R = Rz(yaw) Ry(pitch) Rx(roll)."""
    r = np.asarray(rotation, np.float64)
    flat = float(np.hypot(r[0, 0], r[1, 0]))
    pitch = float(np.arctan2(-r[2, 0], flat))
    if flat < 1e-8:  # gimbal lock: roll and yaw share an axis; yaw is set to 0
        return float(np.arctan2(-r[1, 2], r[1, 1])), pitch, 0.0
    return float(np.arctan2(r[2, 1], r[2, 2])), pitch, float(np.arctan2(r[1, 0], r[0, 0]))
