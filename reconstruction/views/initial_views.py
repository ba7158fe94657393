"""Start poses of the viewpoint search: input cameras, and positions around the target in free space."""

import math

import numpy as np

from reconstruction.core.types import Camera
from reconstruction.views.cameras import look_at, square_camera
from reconstruction.views.config import AvoConfig
from reconstruction.views.scene import Target, ViewScene

_ZOOM = 1.1  # radius of the view at the target relative to its bounding sphere
_WIDEST = 0.8  # largest sine of half the field of view
_AZIMUTHS, _PITCHES_DEG = 12, (6.0, 25.0, 45.0, 65.0)  # directions from the target to the camera
_LOW_PITCHES_DEG = (-4.0, -10.0)
_SHARES = (1.0, 1.2, 0.8, 0.62, 0.48)  # of the target distance, tried in this order until a position is free


def input_starts(scene: ViewScene, target: Target, config: AvoConfig) -> np.ndarray:
    """Return world_from_camera (n, 4, 4) at the input cameras, upright and looking at the target."""
    return np.stack([look_at(p[:3, 3], target.center, config.max_pitch_deg) for p in scene.inputs])


def zoomed_camera(pose: np.ndarray, target: Target, side_px: int) -> Camera:
    """Return a square camera whose field of view holds the target from a pose (4, 4) that looks at it."""
    away = max(float(np.linalg.norm(pose[:3, 3] - target.center)), 1e-6)
    half = math.asin(min(_ZOOM * target.radius_m / away, _WIDEST))
    return square_camera(side_px, 2.0 * math.degrees(half))


def starts_around(scene: ViewScene, target: Target, config: AvoConfig) -> np.ndarray:
    """Return poses (n, 4, 4) around the target in free space, near the target distance."""
    return _around(scene, target, config, _PITCHES_DEG, -math.inf)


def starts_below(scene: ViewScene, target: Target, config: AvoConfig) -> np.ndarray:
    """Return poses (n, 4, 4) that look slightly up from beside the target, not from below its lowest Gaussian.

    They see the underside of objects on legs.
    """
    foot = float(scene.packed[target.rows, 2].min())
    return _around(scene, target, config, _LOW_PITCHES_DEG, foot)


def _around(
    scene: ViewScene, target: Target, config: AvoConfig, pitches_deg: tuple[float, ...], lowest: float
) -> np.ndarray:
    out = []
    for pitch in map(math.radians, pitches_deg):
        for number in range(_AZIMUTHS):
            angle = 2.0 * math.pi * number / _AZIMUTHS
            flat = math.cos(pitch)
            away = np.array([flat * math.cos(angle), flat * math.sin(angle), math.sin(pitch)])
            for share in _SHARES:
                eye = target.center + share * (target.distance_m + target.radius_m) * away
                if eye[2] >= lowest and scene.clearance.at(eye) >= config.clearance_m:
                    out.append(look_at(eye, target.center, config.max_pitch_deg))
                    break
    return np.array(out).reshape(-1, 4, 4)
