"""What stands upright seen from its middle: in which of 16 directions around it what is how far out."""

import numpy as np

from reconstruction.instances.image_colors import SurfaceSamples

DIRECTIONS = 16
MIN_KNOWN = 8  # directions in which two things must be seen to be compared
MIN_SAMPLES = 10
STEEP = 0.5  # of |z| of a normal: sides
_UPRIGHT = 0.35
# How far above and below a height what is compared begins, clear of its blur, and ends. When a seam of color is sure:
# its step, the share of directions with it, how upright what is below must be, how far the colors stay apart.
NEAR_M, FAR_M = 0.006, 0.035
SEAM_COLOR, SEAMS, BELOW, CONTRAST = 8.0, 0.65, 0.5, 12.0


def polar(own: SurfaceSamples, column: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return how far samples (n,) are from the middle of a column (mask) in plan, and in which direction."""
    flat = own.points[:, :2] - middle_of(own, column)
    turn = np.floor(np.arctan2(flat[:, 1], flat[:, 0]) / (2 * np.pi) * DIRECTIONS).astype(int) % DIRECTIONS
    return np.hypot(flat[:, 0], flat[:, 1]), turn


def middle_of(own: SurfaceSamples, column: np.ndarray) -> np.ndarray:
    """Return the middle (2,) of a column in plan."""
    return np.percentile(own.points[column, :2], [5, 95], axis=0).mean(axis=0)


def medians(values: np.ndarray, turn: np.ndarray, chosen: np.ndarray, percent: float = 50.0) -> np.ndarray:
    """Return the median of the chosen values, or another percentile, in each direction, nan where there are too few."""
    out = np.full(DIRECTIONS, np.nan)
    rows = np.flatnonzero(chosen)
    for direction in range(DIRECTIONS):
        there = values[rows[turn[rows] == direction]]
        if len(there) >= 3:
            out[direction] = np.percentile(there, percent)
    return out


def upright_share(own: SurfaceSamples, chosen: np.ndarray) -> float:
    """Return how much of the chosen area is upright."""
    areas = own.areas[chosen]
    return float(areas @ (np.abs(own.normals[chosen, 2]) < _UPRIGHT)) / max(float(areas.sum()), 1e-12)
