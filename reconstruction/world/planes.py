"""Fit planes to surface samples of all frames: level ones (floor, tables) and plumb ones (walls).

The area of a plane is counted in grid cells, so that it does not grow with the number of frames that see it.
"""

from dataclasses import dataclass

import numpy as np

from reconstruction.world.samples import SurfaceSamples

_BAND_SHARE = 0.012  # half the thickness of a plane's band, as a share of the median depth
_CELL_SHARE = 0.04  # side of the cells that measure area, as a share of the median depth
_MIN_CELLS = 40  # smallest area of a plane
_NORMAL_DEG = 15.0  # largest angle between normals and the plane's expected direction
_MAX_PLANES = 6  # per direction
_PATCH_SHARES = (0.05, 0.08, 0.12, 0.2, 0.3, 0.5)  # radii of a growing patch, as shares of the median depth
_MIN_PATCH = 30  # samples of a patch; a plane fitted to fewer follows the noise of single windows


@dataclass(frozen=True)
class FittedPlane:
    """A plane normal . x = offset in `sfm` space."""

    normal: np.ndarray  # float64 (3,) unit
    offset: float  # `sfm` units
    level: bool  # True: horizontal; False: vertical
    area: float  # squared `sfm` units
    sigma_deg: float  # standard error of the normal, from the scatter between frames


def fit_planes(samples: SurfaceSamples, up: np.ndarray) -> tuple[FittedPlane, ...]:
    """Fit the largest level and plumb planes, given `up` (3,) within a few degrees."""
    depth = float(np.median(samples.depths))
    cosine = samples.normals @ up
    tolerance = np.radians(_NORMAL_DEG)
    found = _peel(samples, np.abs(cosine) > np.cos(tolerance), up, True, depth)
    for direction in _wall_directions(samples, up):
        near = np.abs(samples.normals @ direction) > np.cos(tolerance)
        found += _peel(samples, near, direction, False, depth)
    return tuple(found)


def plane_around(samples: SurfaceSamples, point: np.ndarray) -> FittedPlane | None:
    """Fit a plane of any direction to the surface samples around a point, by growing a patch and fitting again.

    Args:
        samples: the sampled surface.
        point: (3,) on the surface, `sfm` space.

    Returns:
        The plane, its normal towards the cameras, `level` without meaning; None where too little flat surface was seen.
    """
    depth = float(np.median(samples.depths))
    away = np.linalg.norm(samples.points - point, axis=1)
    nearest = np.argsort(away, kind="stable")[:_MIN_PATCH]
    if len(nearest) < _MIN_PATCH or away[nearest[-1]] > _PATCH_SHARES[1] * depth:
        return None
    normal = np.median(samples.normals[nearest], axis=0)
    normal /= max(float(np.linalg.norm(normal)), 1e-12)
    through, rows = point, nearest
    for share in _PATCH_SHARES:
        flat = np.abs((samples.points - through) @ normal) < 2 * _BAND_SHARE * depth
        facing = samples.normals @ normal > np.cos(np.radians(_NORMAL_DEG))
        rows = np.flatnonzero(flat & facing & (away < share * depth))
        if len(rows) < _MIN_PATCH:
            if share > _PATCH_SHARES[1]:
                return None
            continue
        normal, offset = _weighted_plane(samples.points[rows], samples.weights[rows], normal)
        through = point + (offset - normal @ point) * normal
    if len(rows) < _MIN_PATCH:
        return None
    area = covered_area(samples.points[rows], normal, _CELL_SHARE * depth)
    sigma = _scatter_deg(samples, rows, normal, normal)
    return FittedPlane(normal, float(normal @ through), True, area, sigma)


def _peel(
    samples: SurfaceSamples, member: np.ndarray, direction: np.ndarray, level: bool, depth: float
) -> list[FittedPlane]:
    """Fit planes with normals near `direction` (3,), each time to the largest peak of the remaining samples."""
    band = _BAND_SHARE * depth
    rest = np.flatnonzero(member)
    found: list[FittedPlane] = []
    while len(rest) >= 200 and len(found) < _MAX_PLANES:
        heights = samples.points[rest] @ direction
        peak = strongest_height(heights, samples.weights[rest], band)
        inside = rest[np.abs(heights - peak) < 3 * band]
        plane = _fit(samples, inside, direction, peak, band, level, depth)
        if plane is not None:
            found.append(plane)
        elif len(inside) < 0.02 * member.sum():
            break
        rest = rest[np.abs(heights - peak) >= 3 * band]
    return found


def strongest_height(heights: np.ndarray, weights: np.ndarray, band: float) -> float:
    """Return the mode of heights (m,), by a smoothed weighted histogram."""
    low = heights.min() - 2 * band
    index = ((heights - low) / (0.5 * band)).astype(np.int64)
    histogram = np.bincount(np.minimum(index, 200_000), weights=weights)
    smooth = np.convolve(histogram, [0.25, 0.75, 1.0, 0.75, 0.25], mode="same")
    return float(low + 0.5 * band * (smooth.argmax() + 0.5))


def _fit(
    samples: SurfaceSamples, rows: np.ndarray, axis: np.ndarray, peak: float, band: float, level: bool, depth: float
) -> FittedPlane | None:  # fmt: skip
    """Fit a plane near offset `peak` along `axis` by reweighted least squares; None if it is too small or oblique."""
    normal, offset = axis, peak
    for factor in (3.0, 2.0, 1.5, 1.0, 1.0, 1.0):
        off = samples.points[rows] @ normal - offset
        weight = samples.weights[rows] * np.maximum(1 - (off / (factor * band)) ** 2, 0.0) ** 2
        # Depth noise grows with depth: far points, which have the most leverage, get less weight.
        weight = weight / (samples.depths[rows] / depth) ** 2
        if (weight > 0).sum() < 100:
            return None
        normal, offset = _weighted_plane(samples.points[rows], weight, axis)
        if np.abs(normal @ axis) < np.cos(np.radians(_NORMAL_DEG)):
            return None
    inside = rows[weight > 0]
    area = covered_area(samples.points[inside], normal, _CELL_SHARE * depth)
    if area < _MIN_CELLS * (_CELL_SHARE * depth) ** 2:
        return None
    return FittedPlane(normal, offset, level, area, _scatter_deg(samples, inside, normal, axis))


def _weighted_plane(points: np.ndarray, weight: np.ndarray, axis: np.ndarray) -> tuple[np.ndarray, float]:
    """Return normal (3,), on the side of `axis`, and offset of the weighted least-squares plane."""
    mean = weight @ points / weight.sum()
    centred = points - mean
    _, vectors = np.linalg.eigh((weight[:, None] * centred).T @ centred)
    normal = vectors[:, 0] * np.sign(vectors[:, 0] @ axis or 1.0)
    return normal, float(normal @ mean)


def _scatter_deg(samples: SurfaceSamples, rows: np.ndarray, normal: np.ndarray, axis: np.ndarray) -> float:
    """Return the standard error of the normal (deg), from fits to five interleaved groups of frames; 3 if unknown."""
    errors = []
    for group in range(5):
        part = rows[samples.frames[rows] % 5 == group]
        if len(part) >= 60:
            other, _ = _weighted_plane(samples.points[part], samples.weights[part], axis)
            errors.append(np.degrees(np.arccos(np.clip(abs(other @ normal), 0, 1))))
    return float(np.sqrt(np.mean(np.square(errors)) / len(errors))) if len(errors) >= 2 else 3.0


def covered_area(points: np.ndarray, normal: np.ndarray, cell: float) -> float:
    """Return the area of the grid cells of side `cell` that hold points (m, 3) projected along `normal`."""
    return len(np.unique(plane_cells(points, normal, cell), axis=0)) * cell**2


def plane_cells(points: np.ndarray, normal: np.ndarray, cell: float) -> np.ndarray:
    """Return the 2D grid cells, int64 (m, 2), of points (m, 3) projected along a normal (3,)."""
    first = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    first /= np.linalg.norm(first)
    axes = np.stack([first, np.cross(normal, first)], axis=1)
    return np.floor(points @ axes / cell).astype(np.int64)


def _wall_directions(samples: SurfaceSamples, up: np.ndarray) -> list[np.ndarray]:
    """Return up to four dominant horizontal directions (3,) of plumb normals, modulo 180 degrees."""
    first = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    first /= np.linalg.norm(first)
    second = np.cross(up, first)
    plumb = np.abs(samples.normals @ up) < np.sin(np.radians(_NORMAL_DEG))
    angle = np.arctan2(samples.normals[plumb] @ second, samples.normals[plumb] @ first) % np.pi
    bins = (angle / np.pi * 90).astype(int) % 90
    histogram = np.bincount(bins, weights=samples.weights[plumb], minlength=90)
    smooth = histogram + 0.7 * (np.roll(histogram, 1) + np.roll(histogram, -1))
    smooth += 0.3 * (np.roll(histogram, 2) + np.roll(histogram, -2))
    found: list[np.ndarray] = []
    for _ in range(4):
        best = int(smooth.argmax())
        if smooth[best] < 0.02 * samples.weights.sum():
            break
        turn = (best + 0.5) / 90 * np.pi
        found.append(np.cos(turn) * first + np.sin(turn) * second)
        smooth[(np.arange(best - 7, best + 8)) % 90] = 0
    return found
