"""Sample oriented surface points from depth maps.

On a plane, inverse depth is an affine function of the pixel. A least-squares fit of 1/z over a window (all windows at
once, by box filters) gives the normal; its residual tells planes from edges, corners and outliers. Pixel coordinates
are free of noise, so depth noise scatters the normals without bias.
"""

from dataclasses import dataclass, fields

import cv2
import numpy as np

from reconstruction.core.types import Camera, DepthMaps, PosedFrames
from reconstruction.world.config import WorldConfig
from registry.errors import InputError

_WINDOW_SHARE = 0.014  # half the window, as a share of the image width: 7 px of 480
_MIN_WINDOW_FILL = 0.35  # smallest share of valid pixels in a window
_GOOD_RESIDUAL = 0.006  # relative residual of plane-sweep depth on a plane; halves the weight
_MAX_RESIDUAL = 0.03  # relative residual above which a pixel is not sampled
_MIN_SAMPLES = 500  # in all frames together
# Farther samples are left out, in shares of the median depth: where the camera only turns, depth goes to infinity, and
# a level patch of noise there covers more area than the floor. With 4 and 10 the same floor is found in such a film.
_FARTHEST = 6.0


@dataclass(frozen=True)
class SurfaceSamples:
    """Oriented points of the seen surface, in `sfm` space and units."""

    points: np.ndarray  # float64 (m, 3)
    normals: np.ndarray  # float64 (m, 3) unit, towards the camera
    weights: np.ndarray  # float64 (m,) planarity of the window, in (0, 1]
    frames: np.ndarray  # int32 (m,) row of the keyframe
    measured: np.ndarray  # bool (m,) False: completed depth
    eyes: np.ndarray  # float64 (m, 3) camera centre of the keyframe
    depths: np.ndarray  # float64 (m,) z-depth in the keyframe


def choose_frames(count: int, limit: int) -> np.ndarray:
    """Return up to `limit` evenly spaced rows of `count`."""
    return np.unique(np.linspace(0, count - 1, min(count, limit)).round().astype(int))


def sample_surface(posed: PosedFrames, depth: DepthMaps, config: WorldConfig) -> SurfaceSamples:
    """Sample oriented points from the depth maps of evenly spaced keyframes.

    Raises:
        InputError: there is too little depth.
    """
    rng = np.random.default_rng(0)
    parts = [
        _sample_frame(depth, int(row), posed.world_from_camera[row], config.samples_per_frame, rng)
        for row in choose_frames(len(posed.world_from_camera), config.max_frames)
    ]
    merged = [np.concatenate([part[i] for part in parts]) for i in range(7)] if parts else []
    if not parts or len(merged[0]) < _MIN_SAMPLES:
        raise InputError(
            "world: the depth maps are almost empty, so floor and gravity cannot be found. Film textured objects from "
            "several sides, slowly, in good light."
        )
    samples = SurfaceSamples(*merged)
    near = samples.depths <= _FARTHEST * np.median(samples.depths)
    return SurfaceSamples(*(getattr(samples, field.name)[near] for field in fields(samples)))


def _sample_frame(
    depth: DepthMaps, row: int, world_from_camera: np.ndarray, limit: int, rng: np.random.Generator
) -> tuple[np.ndarray, ...]:
    """Return the columns of `SurfaceSamples` for up to `limit` random planar pixels of one keyframe."""
    z = np.asarray(depth.depth[row])
    measured = (np.asarray(depth.confidence[row]) >= 2) & (z > 0)
    # Completed pixels come from planes already: use them only where nothing was measured.
    normals, residual = window_normals(z, measured, depth.camera)
    rough = ~np.isfinite(residual)
    if (z[rough] > 0).any():
        normals_all, residual_all = window_normals(z, z > 0, depth.camera)
        normals = np.where(rough[..., None], normals_all, normals)
        residual = np.where(rough, residual_all, residual)
    good = np.flatnonzero((z > 0).ravel() & (residual.ravel() < _MAX_RESIDUAL))
    if len(good) > limit:
        good = np.sort(rng.choice(good, limit, replace=False))
    v, u = np.divmod(good, z.shape[1])
    z_good = z.ravel()[good].astype(np.float64)
    points_camera = depth.camera.unproject(u + 0.5, v + 0.5, z_good)
    rotation, eye = world_from_camera[:3, :3], world_from_camera[:3, 3]
    weights = 1.0 / (1.0 + (residual.ravel()[good] / _GOOD_RESIDUAL) ** 2)
    return (
        points_camera @ rotation.T + eye,
        normals.reshape(-1, 3)[good] @ rotation.T,
        weights,
        np.full(len(good), row, np.int32),
        measured.ravel()[good],
        np.broadcast_to(eye, (len(good), 3)),
        z_good,
    )


def window_normals(z: np.ndarray, valid: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Fit a plane to the window around every pixel.

    Args:
        z: float32 (h, w) z-depth.
        valid: bool (h, w) pixels that take part.
        camera: of the depth map.

    Returns:
        Unit normals (h, w, 3) towards the camera, in the camera frame, and the relative residual (h, w), infinite where
        the window has too few valid pixels.
    """
    half = max(2, round(_WINDOW_SHARE * camera.width))
    rays = camera.pixel_rays()
    x, y = np.ascontiguousarray(rays[..., 0]), np.ascontiguousarray(rays[..., 1])
    m = valid.astype(np.float64)
    w = np.divide(1.0, z, out=np.zeros(z.shape), where=valid)

    def total(image: np.ndarray) -> np.ndarray:
        return cv2.boxFilter(
            image, cv2.CV_64F, (2 * half + 1, 2 * half + 1), normalize=False, borderType=cv2.BORDER_CONSTANT
        )

    n = total(m)
    enough = n >= _MIN_WINDOW_FILL * (2 * half + 1) ** 2
    n = np.where(enough, n, 1.0)
    mean_x, mean_y, mean_w = total(m * x) / n, total(m * y) / n, total(w) / n
    # Second moments about the window's means; coordinates are of order one, so float64 suffices.
    xx, yy = total(m * x * x) / n - mean_x**2, total(m * y * y) / n - mean_y**2
    xy, ww = total(m * x * y) / n - mean_x * mean_y, total(w * w) / n - mean_w**2
    xw, yw = total(w * x) / n - mean_x * mean_w, total(w * y) / n - mean_y * mean_w
    determinant = xx * yy - xy * xy
    enough &= determinant > 1e-3 * (xx + yy) ** 2
    safe = np.where(enough, determinant, 1.0)
    a, b = (yy * xw - xy * yw) / safe, (xx * yw - xy * xw) / safe
    c = mean_w - a * mean_x - b * mean_y
    residual = np.sqrt(np.maximum(ww - a * xw - b * yw, 0.0)) / np.where(enough, mean_w, 1.0)
    # A pixel off the plane of its window (a thin object before a wall) has no valid normal.
    off = np.abs(w - (a * x + b * y + c)) / np.where(enough, mean_w, 1.0)
    enough &= (off < 3 * _MAX_RESIDUAL) | ~valid
    normals = -np.stack([a, b, c], axis=-1)
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    return normals / np.where(length > 0, length, 1.0), np.where(enough, residual, np.inf)
