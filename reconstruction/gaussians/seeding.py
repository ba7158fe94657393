"""Seed Gaussians from fused depth maps: one disk per voxel, with smaller voxels where images have detail."""

import cv2
import numpy as np

from reconstruction.core.types import DepthMaps, PosedFrames
from reconstruction.gaussians.model import N_PARAMETERS, SH_C0
from registry.errors import InputError
from registry.geometry import quat_from_matrix

_COARSE = 3.0  # size of voxels on plain surfaces relative to those with detail
_DETAIL = 6.0  # gray levels: local contrast above which a surface has detail
_JUMP = 0.03  # relative depth difference from which neighbors belong to two surfaces
_SIGMA = 0.6  # standard deviation of a seed, in voxels
_MAX_SAMPLES = 1_500_000  # pixels to sample, about


def normals_of_depth(depth: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Return unit normals (h, w, 3) towards the camera of a depth map; zero at depth edges and unknown pixels."""
    points = depth[..., None] * rays
    normals = np.zeros_like(points)
    dx, dy = points[1:-1, 2:] - points[1:-1, :-2], points[2:, 1:-1] - points[:-2, 1:-1]
    cross = np.cross(dy, dx)
    length = np.linalg.norm(cross, axis=-1, keepdims=True)
    around = np.stack([depth[1:-1, 2:], depth[1:-1, :-2], depth[2:, 1:-1], depth[:-2, 1:-1]])
    smooth = (around.min(0) > 0) & (np.ptp(around, axis=0) < 2 * _JUMP * depth[1:-1, 1:-1])
    normals[1:-1, 1:-1] = np.where(smooth[..., None], cross / np.maximum(length, 1e-12), 0)
    return normals


def local_contrast(gray: np.ndarray) -> np.ndarray:
    """Return the standard deviation (h, w) of gray levels in 5x5 windows."""
    gray = gray.astype(np.float32)
    mean = cv2.blur(gray, (5, 5))
    return np.sqrt(np.maximum(cv2.blur(gray * gray, (5, 5)) - mean * mean, 0))


def disks(
    points: np.ndarray, normals: np.ndarray, rgb: np.ndarray, sigma: np.ndarray, opacity: float
) -> np.ndarray:
    """Pack round disks (n, 13): points (n, 3), unit normals (n, 3), rgb (n, 3) in [0, 1], sigma (n,)."""
    helper = np.where(np.abs(normals[:, 2:]) < 0.9, np.array([[0.0, 0, 1]]), np.array([[1.0, 0, 0]]))
    u = np.cross(helper, normals)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    out = np.empty((len(points), N_PARAMETERS), np.float32)
    out[:, :3] = points
    out[:, 3:7] = quat_from_matrix(np.stack([u, np.cross(normals, u), normals], axis=-1))
    out[:, 7:9] = np.log(sigma)[:, None]
    out[:, 9] = np.log(opacity / (1 - opacity))
    out[:, 10:13] = (rgb - 0.5) / SH_C0
    return out


def seed_from_depth(posed: PosedFrames, depth: DepthMaps, budget: int, opacity: float) -> np.ndarray:
    """Average the oriented points of all frames in voxels and return them as packed seeds (n, 13), n <= budget.

    Raises:
        InputError: no pixel has a depth and a normal.
    """
    samples = _collect_samples(posed, depth)
    points = samples[:, :3]
    if len(points) == 0:
        raise InputError("gaussians: no depth map has a usable pixel, so there is nothing to seed from")
    low, high = np.log(np.median(samples[:, 10])) - 1.0, np.log(np.ptp(points, axis=0).max() + 1e-6)
    detailed = samples[:, 9] > _DETAIL
    for _ in range(12):  # the number of occupied voxels falls with their size: bisect the size
        middle = 0.5 * (low + high)
        if len(np.unique(_voxel_keys(points, detailed, np.exp(middle)))) > budget:
            low = middle
        else:
            high = middle
    size = float(np.exp(high))
    _, row, count = np.unique(_voxel_keys(points, detailed, size), return_inverse=True, return_counts=True)
    weight = 1.0 / samples[:, 10] ** 2  # near views are sharper in depth and color
    total = np.bincount(row, weight, len(count))
    mean = np.stack([np.bincount(row, weight * samples[:, c], len(count)) / total for c in range(10)], axis=1)
    length = np.linalg.norm(mean[:, 3:6], axis=1)
    keep = length > 0.3  # drop voxels with contradictory normals
    mean, normals = mean[keep], mean[keep, 3:6] / length[keep, None]
    spacing = np.where(np.bincount(row, detailed, len(count))[keep] > 0, size, _COARSE * size)
    return disks(mean[:, :3], normals, mean[:, 6:9] / 255.0, _SIGMA * spacing, opacity)


def _voxel_keys(points: np.ndarray, detailed: np.ndarray, size: float) -> np.ndarray:
    """Return a key, int64 (n,), of each point's voxel; points without detail have larger voxels."""
    cell = np.floor(points / np.where(detailed, size, _COARSE * size)[:, None]).astype(np.int64)
    cell -= cell.min(axis=0)
    x, y, z = cell.T
    return ((x << 40) | (y << 20) | z) * 2 + detailed


def _collect_samples(posed: PosedFrames, depth: DepthMaps) -> np.ndarray:
    """Return samples of all frames, float32 (n, 11): world point, world normal, rgb, contrast, pixel footprint."""
    camera = depth.camera
    rays = camera.pixel_rays().astype(np.float32)
    known = int((np.asarray(depth.confidence) > 0).sum())
    step = max(1, int(np.ceil(np.sqrt(known / _MAX_SAMPLES))))
    out = []
    for row, pose in enumerate(posed.world_from_camera):
        z = np.asarray(depth.depth[row]) * (depth.confidence[row] > 0)
        normals = normals_of_depth(z, rays)
        image = cv2.resize(posed.images[row], (camera.width, camera.height), interpolation=cv2.INTER_AREA)
        contrast = local_contrast(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
        grid = np.zeros(z.shape, bool)
        grid[row % step :: step, (row // step) % step :: step] = True
        y, x = np.nonzero(grid & (np.abs(normals).sum(-1) > 0))
        r = pose[:3, :3]
        points = (z[y, x, None] * rays[y, x]) @ r.T + pose[:3, 3]
        footprint = z[y, x] / camera.fx
        columns = [points, normals[y, x] @ r.T, image[y, x], contrast[y, x], footprint]
        out.append(np.column_stack(columns).astype(np.float32))
    return np.concatenate(out) if out else np.zeros((0, 11), np.float32)
