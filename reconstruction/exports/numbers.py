"""Numbers as text: every digit that a float64 has."""

from collections.abc import Iterable

import numpy as np


def text_of(values: Iterable[float]) -> str:
    """Return numbers with spaces between them, as XML attributes have them; they read back as the same floats."""
    return " ".join(repr(float(value) + 0.0) for value in values)


def roll_pitch_yaw(rotation: np.ndarray) -> tuple[float, float, float]:
    """Return URDF's fixed-axis angles (radians) of a rotation (3, 3): Rz(yaw) Ry(pitch) Rx(roll)."""
    r = np.asarray(rotation, np.float64)
    flat = float(np.hypot(r[0, 0], r[1, 0]))
    pitch = float(np.arctan2(-r[2, 0], flat))
    if flat < 1e-9:  # straight up or down: roll and yaw turn about the same axis, yaw is taken as 0
        return float(np.arctan2(-r[1, 2], r[1, 1])), pitch, 0.0
    return float(np.arctan2(r[2, 1], r[2, 2])), pitch, float(np.arctan2(r[1, 0], r[0, 0]))
