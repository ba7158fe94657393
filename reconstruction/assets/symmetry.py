"""Rotation symmetry about vertical axes and mirror symmetry in vertical planes: detection and completion."""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import map_coordinates

from reconstruction.assets.volume import ObjectVolume


@dataclass(frozen=True)
class Symmetry:
    """A mirror symmetry that the seen points support."""

    kind: str  # "mirror-x" | "mirror-y"
    center: np.ndarray  # float64 (2,) a point of the mirror plane, grid frame
    agreement: float  # share of seen points whose mirror images lie on surface


def fit_axis(points: np.ndarray, normals: np.ndarray) -> np.ndarray | None:
    """Fit a vertical axis that the normals of points (k, 3) meet, by iteratively reweighted least squares.

    Returns:
        x, y of the axis (2,); None where the normals do not determine one.
    """
    flat = normals[:, :2]
    size = np.linalg.norm(flat, axis=1)
    use = size > 0.4
    if use.sum() < 60:
        return None
    n, p = flat[use] / size[use, None], points[use, :2]
    across = np.stack([-n[:, 1], n[:, 0]], -1)
    target = np.einsum("nk,nk->n", across, p)
    weight = np.ones(len(p))
    center = p.mean(axis=0)
    for _ in range(12):
        a = across * weight[:, None]
        matrix = a.T @ across
        if np.linalg.cond(matrix) > 60:
            return None
        center = np.linalg.solve(matrix, a.T @ target)
        residual = np.abs(across @ center - target)
        weight = 1.0 / np.maximum(residual, 0.1 * np.median(residual) + 1e-4)
    return center


def rotate_complete(
    volume: ObjectVolume, axis: np.ndarray, points: np.ndarray, normals: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    """Complete a volume by rotation: unknown voxels take the mean of their ring where most of it agrees.

    Args:
        volume: the evidence.
        axis: x, y of the axis (2,).
        points: seen points (k, 3), for the score.
        normals: their normals (k, 3); level surface does not count.

    Returns:
        Signed distance (nx, ny, nz), whether it is known now, and the share of seen side surface that is round.
    """
    v = volume.voxel_m
    x, y = volume.centers(0) - axis[0], volume.centers(1) - axis[1]
    radius = np.hypot(x[:, None], y[None])
    ring = np.floor(radius / v).astype(np.int64)
    n_rings, nz = int(ring.max()) + 1, volume.distance.shape[2]
    index = (ring[:, :, None] * nz + np.arange(nz)).ravel()
    known = volume.known.ravel()
    clipped = np.clip(volume.distance, -volume.trunc_m, volume.trunc_m).ravel()
    total = np.bincount(index, minlength=n_rings * nz)
    count = np.bincount(index[known], minlength=n_rings * nz)
    mean = np.bincount(index[known], weights=clipped[known], minlength=n_rings * nz) / np.maximum(count, 1)
    inside = np.bincount(index[known], weights=(clipped[known] < 0).astype(float), minlength=n_rings * nz)
    share = inside / np.maximum(count, 1)
    decided = (count > 0.08 * total) & ((share > 0.75) | (share < 0.25)) & (count > 3)
    tolerance = max(1.2 * v, 2.0 * volume.noise_m)
    score = _round_share(volume, axis, points, normals)
    ring_mean = mean[index]
    fill = ~known & decided[index]
    out = volume.distance.ravel().copy()
    out[fill] = ring_mean[fill]
    smooth = known & decided[index] & (np.abs(ring_mean - clipped) < tolerance)
    out[smooth] = 0.3 * clipped[smooth] + 0.7 * ring_mean[smooth]
    known_now = (known | fill).reshape(volume.known.shape)
    return out.reshape(volume.distance.shape).astype(np.float32), known_now, score


def _round_share(volume: ObjectVolume, axis: np.ndarray, points: np.ndarray, normals: np.ndarray) -> float:
    """Return the share of seen side surface at the median radius of its height, outside and inside apart."""
    sideways = np.hypot(normals[:, 0], normals[:, 1]) > 0.7
    if sideways.sum() < 50:
        return 0.0
    p, n = points[sideways], normals[sideways]
    away = p[:, :2] - axis
    radius = np.hypot(away[:, 0], away[:, 1])
    outwards = np.einsum("nk,nk->n", away, n[:, :2]) > 0
    layer = np.floor((p[:, 2] - volume.origin[2]) / max(volume.voxel_m, 0.003)).astype(int)
    group = 2 * (layer - layer.min()) + outwards
    order = np.lexsort((radius, group))
    starts = np.searchsorted(group[order], np.arange(group.max() + 2))
    middle = np.minimum((starts[:-1] + starts[1:]) // 2, len(order) - 1)
    usual = radius[order][middle][group]
    large = float(np.percentile(radius, 90))
    # A box's radius varies by 41 %: a tolerance beyond 7 % could not tell it from a cylinder.
    tolerance = min(
        max(volume.voxel_m, 2.0 * volume.noise_m, 0.03 * large), max(volume.voxel_m, 0.07 * large)
    )
    return float((np.abs(radius - usual) < tolerance).mean())


def _sample(volume: ObjectVolume, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the interpolated distance at points (n, 3), and whether it is known there."""
    cell = ((points - volume.origin) / volume.voxel_m - 0.5).T
    value = map_coordinates(volume.distance, cell, order=1, mode="nearest")
    nearest = np.round(cell).astype(int)
    inside = np.all((nearest >= 0) & (nearest < np.array(volume.distance.shape)[:, None]), axis=0)
    nearest = np.clip(nearest, 0, np.array(volume.distance.shape)[:, None] - 1)
    return value, volume.known[tuple(nearest)] & inside


def find_mirror(volume: ObjectVolume, points: np.ndarray, axis: int) -> Symmetry | None:
    """Return the best mirror plane across `axis` (0: x, 1: y) near the middle; None where the points support none."""
    thin = points[:: max(1, len(points) // 4000)]
    low, high = np.percentile(thin[:, axis], [1, 99])
    middle, reach = (low + high) / 2, 0.15 * (high - low)
    steps = int(np.clip(np.ceil(reach / volume.voxel_m), 1, 14))
    tolerance = max(1.5 * volume.voxel_m, 2.5 * volume.noise_m)
    best, best_score = None, 0.0
    for offset in np.linspace(-reach, reach, 2 * steps + 1):
        mirrored = thin.copy()
        mirrored[:, axis] = 2 * (middle + offset) - mirrored[:, axis]
        value, known = _sample(volume, mirrored)
        agree = (known & (np.abs(value) < tolerance)).mean()
        violate = (known & (value >= tolerance)).mean()
        buried = (known & (value <= -tolerance)).mean()
        wrong = violate + 0.5 * buried
        if agree < 0.25 or wrong > 0.06 + 0.08 * agree:
            continue
        score = agree - 3 * wrong - 0.05 * abs(offset) / max(reach, 1e-9)
        if score > best_score:
            center = np.zeros(2)
            center[axis] = middle + offset
            best, best_score = Symmetry(f"mirror-{'xy'[axis]}", center, float(agree)), score
    return best


def mirror_complete(volume: ObjectVolume, found: Symmetry) -> tuple[np.ndarray, np.ndarray]:
    """Fill unknown voxels from their mirror images; return the distance (nx, ny, nz) and whether it is known now."""
    axis = 0 if found.kind == "mirror-x" else 1
    n = volume.distance.shape[axis]
    position = (2 * found.center[axis] - volume.centers(axis) - volume.origin[axis]) / volume.voxel_m - 0.5
    low = np.floor(position).astype(int)
    t = (position - low).astype(np.float32)
    valid = (low >= 0) & (low + 1 < n)
    a, b = np.clip(low, 0, n - 1), np.clip(low + 1, 0, n - 1)
    view = [1, 1, 1]
    view[axis] = n
    t, valid = t.reshape(view), valid.reshape(view)
    value = np.take(volume.distance, a, axis) * (1 - t) + np.take(volume.distance, b, axis) * t
    known = np.take(volume.known, a, axis) & np.take(volume.known, b, axis) & valid
    fill = known & ~volume.known
    return np.where(fill, value, volume.distance).astype(np.float32), volume.known | fill
