"""Estimate yaw: align x and y with walls and upright furniture faces, if there are enough of them."""

import numpy as np

from reconstruction.world.planes import FittedPlane
from reconstruction.world.samples import SurfaceSamples

_UPRIGHT_DEG = 12.0  # largest elevation of an upright face's normal
_MIN_SHARE = 0.02  # smallest share of upright samples
_WALL_AGREES_DEG = 3.0  # largest angle between a fitted wall and the votes for it to refine them
_WALL_SIGMA_DEG = 0.5  # standard deviation of a wall's direction, besides that of its fit
_MIN_CONTRAST = 1.8  # smallest ratio of the histogram's peak to its mean


def level_rotation(up: np.ndarray) -> np.ndarray:
    """Return the smallest rotation (3, 3) that takes the unit vector `up` (3,) to +z."""
    axis, cosine = np.cross(up, [0, 0, 1.0]), float(up[2])
    if cosine < -1 + 1e-9:
        return np.diag([1.0, -1.0, -1.0])
    skew = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + skew + skew @ skew / (1 + cosine)


def turn_about_z(angle_rad: float) -> np.ndarray:
    """Return the rotation (3, 3) by an angle about +z."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])


def find_yaw(
    samples: SurfaceSamples, forward: np.ndarray, walls: tuple[FittedPlane, ...] = ()
) -> tuple[float, bool]:
    """Return the rotation about +z (radians) that aligns walls with x and y, and whether there are walls.

    Of the four quarter turns, the one is taken after which the mean viewing direction is closest to +y. Without walls
    it is exactly +y.

    Args:
        samples: upright samples (+z up).
        forward: viewing directions (n, 3) of the cameras, upright.
        walls: plumb planes, upright; they refine the angle found from normals.
    """
    heading = _heading(forward)
    angles, weights = _wall_angles(samples)
    if weights.sum() < _MIN_SHARE * samples.weights.sum():
        return np.pi / 2 - heading, False
    # Modulo a quarter turn, all four wall directions of a room vote for the same angle.
    histogram = np.bincount((angles / (np.pi / 2) * 180).astype(int) % 180, weights=weights, minlength=180)
    kernel = np.exp(-0.5 * (np.minimum(np.arange(180), 180 - np.arange(180)) / 4.0) ** 2)  # 2 degrees wide
    smooth = np.fft.irfft(np.fft.rfft(histogram) * np.fft.rfft(kernel), 180)
    best = (float(smooth.argmax()) + 0.5) / 180 * np.pi / 2
    if smooth.max() < _MIN_CONTRAST * smooth.mean():
        return np.pi / 2 - heading, False
    for width_deg in (8.0, 6.0, 4.0, 3.0, 3.0, 3.0):
        off = _folded(angles - best)
        vote = weights * np.maximum(1 - (off / np.radians(width_deg)) ** 2, 0.0) ** 2
        if vote.sum() > 0:
            best += float((vote * off).sum() / vote.sum())
    best = _refine_on_walls(best, walls)
    quarter = np.round((np.pi / 2 - (heading - best)) / (np.pi / 2))
    return float(quarter * np.pi / 2 - best), True


def _refine_on_walls(best: float, walls: tuple[FittedPlane, ...]) -> float:
    """Return the angle corrected by the weighted mean deviation of the walls that agree with it."""
    near = [(_folded(np.arctan2(p.normal[1], p.normal[0]) - best), p) for p in walls]
    near = [(off, p) for off, p in near if abs(off) < np.radians(_WALL_AGREES_DEG)]
    if not near:
        return best
    weight = np.array([p.area / (p.sigma_deg**2 + _WALL_SIGMA_DEG**2) for _, p in near])
    return best + float(weight @ [off for off, _ in near] / weight.sum())


def _folded(angle: np.ndarray) -> np.ndarray:
    """Return the angle modulo a quarter turn, in [-pi / 4, pi / 4)."""
    return (angle + np.pi / 4) % (np.pi / 2) - np.pi / 4


def _wall_angles(samples: SurfaceSamples) -> tuple[np.ndarray, np.ndarray]:
    """Return the azimuths (u,) of upright normals modulo a quarter turn, and their weights."""
    upright = np.abs(samples.normals[:, 2]) < np.sin(np.radians(_UPRIGHT_DEG))
    angles = np.arctan2(samples.normals[upright, 1], samples.normals[upright, 0]) % (np.pi / 2)
    # Weigh by area: far walls cover few pixels. The factor is bounded.
    near = np.median(samples.depths)
    return angles, samples.weights[upright] * np.minimum(samples.depths[upright] / near, 2.0) ** 2


def _heading(forward: np.ndarray) -> float:
    """Return the mean azimuth of the viewing directions (radians from +x)."""
    mean = forward[:, :2].mean(axis=0)
    if np.linalg.norm(mean) < 0.2:
        # No common direction: take the most horizontal view.
        mean = forward[np.linalg.norm(forward[:, :2], axis=1).argmax(), :2]
    return float(np.arctan2(mean[1], mean[0]))
