"""Estimate the up direction from camera orientations, surface normals and fitted planes.

Hand-held cameras have little roll but any pitch: each camera's x axis is orthogonal to up within a few degrees, while
its -y axis is only roughly up. They look down rather than up: a plane that fills the view is a table from above or a
wall from below, and the first is usual. Candidate directions near that prior are scored by the share of surface that
they make horizontal or vertical. The best is refined by iteratively reweighted least squares on the normals, then on
planes fitted to whole floors, tables and walls.
"""

from dataclasses import dataclass

import numpy as np

from reconstruction.core.types import PosedFrames
from reconstruction.world.planes import FittedPlane, fit_planes
from reconstruction.world.samples import SurfaceSamples

_ROLL_SIGMA_DEG = 4.0  # standard deviation of camera roll
_PITCH_SIGMA_DEG = 28.0  # standard deviation of camera pitch, where cameras alone decide
# Mean and standard deviation of the elevation of a film's view. Bench, films of other families and of kitchen, dorm and
# bedroom have -58 to -11 degrees; with means of -12 to -22 and deviations of 20 to 28 all of them get the same up.
_ELEVATION_DEG, _ELEVATION_SIGMA_DEG = -20.0, 24.0
_SEARCH_DEG = 75.0  # largest angle between candidates and the camera prior
_MAX_ROLL_COST = 1.8  # in log votes: six times the surface outweighs any roll
_VOTE_WIDTH_DEG = 5.0  # standard deviation of a normal's vote
_WALL_SHARE = (
    0.35  # weight of vertical surface: one rotation stays free, and furniture has many upright faces
)
_PLANE_SIGMA_DEG = 0.6  # standard deviation of floors, tables and walls from level or plumb
_SYSTEMATIC_DEG = 0.15  # lower bound of the reported standard deviation
_MIN_EVIDENCE = 0.03  # smallest share of level or plumb surface for plane fitting


@dataclass(frozen=True)
class Gravity:
    """The up direction, its evidence and its accuracy."""

    up: np.ndarray  # float64 (3,) unit, `sfm` space
    method: str  # "planes+walls+cameras" | "planes+cameras" | "walls+cameras" | "cameras"
    sigma_deg: float  # standard deviation
    planes: tuple[FittedPlane, ...]  # level and plumb planes that determined it


def find_gravity(posed: PosedFrames, samples: SurfaceSamples) -> Gravity:
    """Estimate up in `sfm` space."""
    right, down, forward = np.moveaxis(posed.world_from_camera[:, :3, :3], 2, 0)
    prior = camera_up(right, -down)
    start = _best_vote(prior, right, forward, samples)
    up = _refine_on_normals(start, right, samples)
    level, plumb = _evidence(up, samples)
    planes = fit_planes(samples, up) if max(level, plumb) > _MIN_EVIDENCE else ()
    if planes:
        up, sigma = _refine_on_planes(up, right, planes)
    else:
        sigma = _camera_sigma(prior, right)
    has_level = any(p.level for p in planes)
    has_plumb = any(not p.level for p in planes)
    if not has_level and has_plumb:
        # Parallel walls leave the rotation about their normal to the cameras.
        sigma = max(sigma, _camera_sigma(up, right) if _walls_are_parallel(planes) else sigma)
    parts = ["planes"] * has_level + ["walls"] * has_plumb + ["cameras"]
    return Gravity(up, "+".join(parts), float(sigma), planes)


def camera_up(right: np.ndarray, rough_up: np.ndarray) -> np.ndarray:
    """Estimate up (3,) from cameras alone: no roll, moderate pitch; robust to some rolled frames.

    Args:
        right: x axes (n, 3) of the cameras.
        rough_up: -y axes (n, 3) of the cameras.
    """
    weights = np.ones(len(right))
    up = _unit(np.median(rough_up, axis=0))
    for _ in range(10):
        roll = (weights[:, None] * right).T @ right / np.sin(np.radians(_ROLL_SIGMA_DEG)) ** 2
        pitch = (weights[:, None] * rough_up).T @ rough_up / np.sin(np.radians(_PITCH_SIGMA_DEG)) ** 2
        _, vectors = np.linalg.eigh(roll - pitch)
        up = vectors[:, 0] * np.sign(vectors[:, 0] @ rough_up.sum(axis=0) or 1.0)
        error_deg = np.degrees(np.arcsin(np.clip(np.abs(right @ up), 0, 1)))
        weights = 1.0 / (1.0 + (error_deg / (2 * _ROLL_SIGMA_DEG)) ** 2)
    return up


def _best_vote(
    prior: np.ndarray, right: np.ndarray, forward: np.ndarray, samples: SurfaceSamples
) -> np.ndarray:
    """Return the candidate near the prior with the most level and plumb surface, the least roll, and a usual elevation.

    Args:
        prior: rough up (3,).
        right: x axes (n, 3) of the cameras.
        forward: z axes (n, 3) of the cameras.
        samples: of the seen surface.
    """
    normals, mass = _binned(samples)
    candidates = _fibonacci_sphere(6000)
    candidates = candidates[candidates @ prior > np.cos(np.radians(_SEARCH_DEG))]
    cosine = candidates @ normals.T
    width = np.radians(_VOTE_WIDTH_DEG)
    level = np.exp(-0.5 * (np.arccos(np.clip(cosine, -1, 1)) / width) ** 2)
    plumb = np.exp(-0.5 * (np.arcsin(np.clip(cosine, -1, 1)) / width) ** 2)
    votes = (level + _WALL_SHARE * plumb) @ mass
    roll = np.arcsin(np.clip(candidates @ right.T, -1, 1)) / np.radians(_ROLL_SIGMA_DEG)
    # Cauchy-like and bounded, so that neither a few rolled frames nor a wholly rolled video outvote the surface.
    roll_cost = np.minimum(np.log1p(0.5 * roll**2).mean(axis=1), _MAX_ROLL_COST)
    elevation_deg = np.degrees(np.arcsin(np.clip(candidates @ _unit(forward.mean(axis=0)), -1, 1)))
    unusual = (elevation_deg - _ELEVATION_DEG) / _ELEVATION_SIGMA_DEG
    return candidates[np.argmax(np.log(votes + 0.02) - roll_cost - 0.5 * unusual**2)]


def _binned(samples: SurfaceSamples) -> tuple[np.ndarray, np.ndarray]:
    """Bin the normals; return mean directions (k, 3) and the share of surface (k,) in each bin."""
    keys = np.round(samples.normals * 14).astype(np.int64) + 20
    _, bins = np.unique(keys @ [1600, 40, 1], return_inverse=True)
    total = [np.bincount(bins, weights=samples.weights * samples.normals[:, k]) for k in range(3)]
    mass = np.bincount(bins, weights=samples.weights)
    directions = np.stack(total, axis=1)
    return directions / np.linalg.norm(directions, axis=1, keepdims=True), mass / mass.sum()


def _refine_on_normals(up: np.ndarray, right: np.ndarray, samples: SurfaceSamples) -> np.ndarray:
    """Refine up by reweighted least squares: level normals parallel to it, plumb ones and camera x axes orthogonal."""
    for width_deg in (8.0, 6.0, 5.0, 4.0, 3.0, 3.0, 3.0, 3.0):
        width = np.radians(width_deg)
        cosine = np.clip(samples.normals @ up, -1, 1)
        level = samples.weights * _biweight(np.arccos(np.abs(cosine)) / (2 * width))
        plumb = _WALL_SHARE * samples.weights * _biweight(np.arcsin(cosine) / (2 * width))
        n = samples.normals
        matrix = level.sum() * np.eye(3) - (level[:, None] * n).T @ n + (plumb[:, None] * n).T @ n
        # A small weight: cameras decide only what the surface leaves open.
        matrix += 1e-3 * samples.weights.sum() * right.T @ right / len(right)
        _, vectors = np.linalg.eigh(matrix)
        up = vectors[:, 0] * np.sign(vectors[:, 0] @ up)
    return up


def _refine_on_planes(
    up: np.ndarray, right: np.ndarray, planes: tuple[FittedPlane, ...]
) -> tuple[np.ndarray, float]:
    """Refine up by robust least squares over fitted planes and cameras; return it and its standard deviation (deg)."""
    camera = right.T @ right / len(right) / np.radians(_ROLL_SIGMA_DEG) ** 2
    normals = np.array([p.normal for p in planes])
    level = np.array([p.level for p in planes])
    share = np.array([p.area for p in planes]) / sum(p.area for p in planes)
    sigma = np.radians(np.hypot(_PLANE_SIGMA_DEG, [p.sigma_deg for p in planes]))
    for _ in range(20):
        cosine = np.clip(np.abs(normals @ up), 0, 1)
        error = np.where(level, np.arccos(cosine), np.arcsin(cosine)) / sigma
        weight = len(planes) * share / sigma**2 / (1 + error**2) ** 2
        matrix = camera.copy()
        for n, w, is_level in zip(normals, weight, level):
            matrix += w * (np.eye(3) - np.outer(n, n) if is_level else np.outer(n, n))
        values, vectors = np.linalg.eigh(matrix)
        up = vectors[:, 0] * np.sign(vectors[:, 0] @ up)
    # The second smallest eigenvalue is the information about the least certain rotation.
    sigma = 1 / np.sqrt(max(values[1] - values[0], 1e-9))
    return up, float(np.degrees(np.hypot(sigma, np.radians(_SYSTEMATIC_DEG))))


def _evidence(up: np.ndarray, samples: SurfaceSamples) -> tuple[float, float]:
    """Return the shares of surface that are level and plumb within 8 degrees."""
    cosine = samples.normals @ up
    total = samples.weights.sum()
    level = samples.weights[np.abs(cosine) > np.cos(np.radians(8))].sum() / total
    return float(level), float(samples.weights[np.abs(cosine) < np.sin(np.radians(8))].sum() / total)


def _walls_are_parallel(planes: tuple[FittedPlane, ...]) -> bool:
    normals = np.array([p.normal for p in planes])
    return bool(np.abs(normals @ normals.T).min() > np.cos(np.radians(20)))


def _camera_sigma(up: np.ndarray, right: np.ndarray) -> float:
    """Return the standard deviation of camera roll (deg), by the median absolute deviation, at least 1.5."""
    roll_deg = np.degrees(np.arcsin(np.clip(right @ up, -1, 1)))
    return float(max(1.5, 1.4826 * np.median(np.abs(roll_deg))))


def _biweight(x: np.ndarray) -> np.ndarray:
    return np.where(np.abs(x) < 1, (1 - x**2) ** 2, 0.0)


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / max(np.linalg.norm(vector), 1e-12)


def _fibonacci_sphere(count: int) -> np.ndarray:
    i = np.arange(count) + 0.5
    z = 1 - 2 * i / count
    angle = np.pi * (1 + 5**0.5) * i
    r = np.sqrt(1 - z**2)
    return np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=1)
