"""Seed Gaussians in holes without measured depth, at depth interpolated from around the hole."""

import cv2
import numpy as np

from reconstruction.gaussians.losses import FrameTarget
from reconstruction.gaussians.model import N_PARAMETERS
from reconstruction.gaussians.rendering import Render
from reconstruction.gaussians.seeding import disks

_STRIDE = 4  # pixels between two Gaussians
_OPACITY = 0.5  # of a new Gaussian


def interpolate_inverse_depth(inverse: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Fill the unknown pixels of an inverse depth map (h, w) by pull-push over an image pyramid."""
    height, width = inverse.shape
    if height <= 2 or width <= 2 or known.all():
        mean = inverse[known].mean() if known.any() else 0.0
        return np.where(known, inverse, mean)
    half = (max(1, width // 2), max(1, height // 2))
    weight = cv2.resize(known.astype(np.float32), half, interpolation=cv2.INTER_AREA)
    value = cv2.resize(np.where(known, inverse, 0).astype(np.float32), half, interpolation=cv2.INTER_AREA)
    coarse = interpolate_inverse_depth(value / np.maximum(weight, 1e-6), weight > 1e-3)
    smooth = cv2.resize(coarse.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)
    return np.where(known, inverse, smooth)


def fill_holes(render: Render, target: FrameTarget, world_from_camera: np.ndarray) -> np.ndarray:
    """Return packed Gaussians (n, 13) for pixels of low opacity in a render; they face the camera."""
    solid = render.opacity > 0.7
    hole = cv2.erode((render.opacity < 0.4).astype(np.uint8), np.ones((3, 3), np.uint8))
    grid = np.zeros(hole.shape, bool)
    grid[_STRIDE // 2 :: _STRIDE, _STRIDE // 2 :: _STRIDE] = True
    y, x = np.nonzero(grid & (hole > 0))
    if len(y) == 0 or not solid.any():
        return np.zeros((0, N_PARAMETERS), np.float32)
    inverse = np.where(solid, 1 / np.maximum(render.depth, 1e-9), 0)
    z = 1 / np.maximum(interpolate_inverse_depth(inverse, solid)[y, x], 1e-9)
    rays = target.camera.pixel_rays()[y, x]
    rotation = world_from_camera[:3, :3]
    points = (z[:, None] * rays) @ rotation.T + world_from_camera[:3, 3]
    normals = -(rays / np.linalg.norm(rays, axis=1, keepdims=True)) @ rotation.T
    color = cv2.blur(target.image, (_STRIDE, _STRIDE))[y, x]
    return disks(points, normals, color, 0.6 * _STRIDE * z / target.camera.fx, _OPACITY)
