"""Oriented surface points from depth maps: what gravity, walls and the floor are voted by.

On a plane the inverse depth is an affine function of the pixel, so a least-squares fit of 1/z over a window
(all windows at once, by box sums) gives the normal. Its residual tells planes from edges, corners and bad
depth. The pixel coordinates carry no noise, hence noise of the depth spreads the normals but does not bias
them.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from reconstruction.core.types import Camera, DepthMaps, PosedFrames
from reconstruction.world.config import WorldConfig
from registry.errors import InputError

_WINDOW_SHARE = 0.014  # half the window, as a share of the image width: 7 px of 480
_MIN_WINDOW_FILL = 0.35
_GOOD_RESIDUAL = 0.006  # relative: what a plane sweep leaves on a plane
_MAX_RESIDUAL = 0.03
_MIN_SAMPLES = 500


@dataclass(frozen=True)
class SurfaceSamples:
    """Points of the seen surface with normals, in sfm space."""

    points: np.ndarray  # float64 (m, 3)
    normals: np.ndarray  # float64 (m, 3) unit, towards the camera
    weights: np.ndarray  # float64 (m,) how planar the surroundings are, in (0, 1]
    frames: np.ndarray  # int32 (m,) row of the camera that sees the point
    measured: np.ndarray  # bool (m,) False: completed by a plane
    eyes: np.ndarray  # float64 (m, 3) centre of that camera
    depths: np.ndarray  # float64 (m,) z-depth


def choose_frames(count: int, limit: int) -> np.ndarray:
    """Return up to `limit` rows, evenly spread."""
    return np.unique(np.linspace(0, count - 1, min(count, limit)).round().astype(int))


def sample_surface(posed: PosedFrames, depth: DepthMaps, config: WorldConfig) -> SurfaceSamples:
    """Take oriented points from the depth maps of evenly chosen keyframes.

    Raises:
        InputError: there is next to no depth.
    """
    rng = np.random.default_rng(0)
    parts = []
    for row in choose_frames(len(posed.world_from_camera), config.max_frames):
        found = _sample_frame(depth, int(row), posed.world_from_camera[row], config.samples_per_frame, rng)
        parts.append(found)
    merged = [np.concatenate([part[i] for part in parts]) for i in range(7)] if parts else []
    if not parts or len(merged[0]) < _MIN_SAMPLES:
        raise InputError(
            "world: the depth maps are almost empty, so neither the floor nor gravity can be found. Film "
            "textured things from several sides, slowly, in good light."
        )
    return SurfaceSamples(*merged)


def _sample_frame(
    depth: DepthMaps, row: int, world_from_camera: np.ndarray, limit: int, rng: np.random.Generator
) -> tuple[np.ndarray, ...]:
    z = np.asarray(depth.depth[row])
    measured = (np.asarray(depth.confidence[row]) >= 2) & (z > 0)
    # Completed pixels were made by planes already: they count only where nothing was measured.
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
    x, y = normalised(depth.camera)
    points_camera = np.stack([x[u] * z_good, y[v] * z_good, z_good], axis=1)
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


def normalised(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return x/z of the columns (w,) and y/z of the rows (h,)."""
    x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    y = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    return x, y


def window_normals(z: np.ndarray, valid: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Fit a plane around every pixel.

    Args:
        z: z-depth, float32 (h, w).
        valid: bool (h, w), which pixels take part.
        camera: The camera of the depth map.

    Returns:
        Unit normals towards the camera (h, w, 3) in camera space, and the relative residual (h, w), infinite
        where the window is too empty.
    """
    half = max(2, round(_WINDOW_SHARE * camera.width))
    x, y = normalised(camera)
    x, y = np.broadcast_to(x, z.shape), np.broadcast_to(y[:, None], z.shape)
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
    # Second moments about the window's own means; coordinates are of order one, so float64 leaves nothing
    # out.
    xx, yy = total(m * x * x) / n - mean_x**2, total(m * y * y) / n - mean_y**2
    xy, ww = total(m * x * y) / n - mean_x * mean_y, total(w * w) / n - mean_w**2
    xw, yw = total(w * x) / n - mean_x * mean_w, total(w * y) / n - mean_y * mean_w
    determinant = xx * yy - xy * xy
    enough &= determinant > 1e-3 * (xx + yy) ** 2
    safe = np.where(enough, determinant, 1.0)
    a, b = (yy * xw - xy * yw) / safe, (xx * yw - xy * xw) / safe
    c = mean_w - a * mean_x - b * mean_y
    residual = np.sqrt(np.maximum(ww - a * xw - b * yw, 0.0)) / np.where(enough, mean_w, 1.0)
    # At a pixel off its own window's plane (a thin thing before a wall) the normal says nothing about it.
    off = np.abs(w - (a * x + b * y + c)) / np.where(enough, mean_w, 1.0)
    enough &= (off < 3 * _MAX_RESIDUAL) | ~valid
    normals = -np.stack([a, b, c], axis=-1)
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    return normals / np.where(length > 0, length, 1.0), np.where(enough, residual, np.inf)
