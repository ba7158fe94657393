"""Which way x and y run: along the walls and upright furniture faces, where there are enough of them."""

import numpy as np

from reconstruction.world.planes import FittedPlane
from reconstruction.world.samples import SurfaceSamples

_UPRIGHT_DEG = 12.0
_MIN_SHARE = 0.02  # of all samples: fewer upright ones say nothing
_WALL_AGREES_DEG = 3.0
_WALL_SIGMA_DEG = 0.5
_MIN_CONTRAST = 1.8  # how much the votes near the found direction exceed an even spread


def level_rotation(up: np.ndarray) -> np.ndarray:
    """Return the smallest rotation (3, 3) that takes `up` to +z."""
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
    """Return the turn about +z that makes walls parallel to x and y, and whether there were any.

    Of the four quarter turns the one is taken after which the cameras look along +y on the whole; without
    walls they look exactly along +y.

    Args:
        samples: Upright samples (+z is up).
        forward: The cameras' viewing directions (n, 3), upright.
        walls: Plumb planes, upright: where they agree with the votes of the normals, they are more exact.
    """
    heading = _heading(forward)
    angles, weights = _wall_angles(samples)
    if weights.sum() < _MIN_SHARE * samples.weights.sum():
        return np.pi / 2 - heading, False
    # Fold by a quarter turn: all four wall directions of a room vote for the same angle.
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
    """Return the angle improved by whole walls: a fit through a wall averages over more than any window."""
    near = [(_folded(np.arctan2(p.normal[1], p.normal[0]) - best), p) for p in walls]
    near = [(off, p) for off, p in near if abs(off) < np.radians(_WALL_AGREES_DEG)]
    if not near:
        return best
    weight = np.array([p.area / (p.sigma_deg**2 + _WALL_SIGMA_DEG**2) for _, p in near])
    return best + float(weight @ [off for off, _ in near] / weight.sum())


def _folded(angle: np.ndarray | float) -> np.ndarray | float:
    """Fold an angle to within an eighth of a turn."""
    return (angle + np.pi / 4) % (np.pi / 2) - np.pi / 4


def _wall_angles(samples: SurfaceSamples) -> tuple[np.ndarray, np.ndarray]:
    upright = np.abs(samples.normals[:, 2]) < np.sin(np.radians(_UPRIGHT_DEG))
    angles = np.arctan2(samples.normals[upright, 1], samples.normals[upright, 0]) % (np.pi / 2)
    # Far walls cover few pixels but are what a room is aligned to: weigh by area, up to a point.
    near = np.median(samples.depths)
    return angles, samples.weights[upright] * np.minimum(samples.depths[upright] / near, 2.0) ** 2


def _heading(forward: np.ndarray) -> float:
    """Return the direction (radians from +x) in which the cameras look on the whole."""
    mean = forward[:, :2].mean(axis=0)
    if np.linalg.norm(mean) < 0.2:
        # They look all around, or straight down: then the levelest one decides.
        mean = forward[np.linalg.norm(forward[:, :2], axis=1).argmax(), :2]
    return float(np.arctan2(mean[1], mean[0]))
