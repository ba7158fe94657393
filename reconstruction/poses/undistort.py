"""Undistort images: find a pinhole camera that the distorted images cover, and resample them to it."""

import cv2
import numpy as np

from reconstruction.core.types import Camera, DistortedCamera
from reconstruction.poses.colmap_types import ColmapCamera

_NEGLIGIBLE_PX = 0.3  # displacement up to which images are left as they are, as resampling blurs


def undistort(
    camera: ColmapCamera, image_sets: list[np.ndarray], offset_sets: list[np.ndarray] | None = None
) -> tuple[Camera, list[np.ndarray], DistortedCamera | None]:
    """Return a pinhole camera of the same size whose view the images cover, and the images resampled to it.

    Args:
        camera: distorted camera of the images.
        image_sets: uint8 arrays (n, h, w, 3); returned as they are where the distortion is negligible.
        offset_sets: (n, 2) in pixels for each set, of the principal point of each image; None: there are none.

    Returns:
        The pinhole camera, its images, and the distorted camera; None where the distortion is negligible.
    """
    width, height = camera.width, camera.height
    fx, fy = camera.focal_length_x, camera.focal_length_y
    pinhole = Camera(width, height, fx, fy, camera.principal_point_x, camera.principal_point_y)
    pixels = _pixel_grid(width, height)
    negligible = np.abs(_source_pixels(camera, pinhole, pixels) - pixels).max() <= _NEGLIGIBLE_PX
    if negligible and offset_sets is None:
        return pinhole, image_sets, None
    offset_sets = offset_sets or [np.zeros((len(images), 2)) for images in image_sets]
    pinhole = _covering_pinhole(camera, np.concatenate([np.zeros((1, 2)), *offset_sets]))
    source = _source_pixels(camera, pinhole, pixels).reshape(height, width, 2).astype(np.float32)
    source -= np.float32(0.5)
    distorted = DistortedCamera(camera.model_name, width, height, np.array(camera.params, np.float64))
    return pinhole, [_resample(*pair, source) for pair in zip(image_sets, offset_sets)], distorted


def _resample(images: np.ndarray, offsets: np.ndarray, source: np.ndarray) -> np.ndarray:
    out = np.empty_like(images)
    for row, image in enumerate(images):
        pixels, mode = np.ascontiguousarray(image), cv2.BORDER_REPLICATE
        at = source + offsets[row].astype(np.float32)
        out[row] = cv2.remap(pixels, at, None, cv2.INTER_LANCZOS4, borderMode=mode)  # pyright: ignore[reportCallIssue, reportArgumentType]
    return out


def _pixel_grid(width: int, height: int) -> np.ndarray:
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    return np.stack([u, v], axis=-1).reshape(-1, 2)


def _source_pixels(camera: ColmapCamera, pinhole: Camera, pixels: np.ndarray) -> np.ndarray:
    """Return the position (n, 2) in the distorted image of each pixel (n, 2) of the pinhole image."""
    rays = pinhole.unproject(pixels[:, 0], pixels[:, 1], np.ones(len(pixels)))
    return np.asarray(camera.img_from_cam(rays))


def _covering_pinhole(camera: ColmapCamera, offsets: np.ndarray) -> Camera:
    """Find the widest centered pinhole camera of the same size whose view the distorted images cover, by bisection.

    `offsets`: (n, 2) of the principal points of the images.
    """
    width, height = camera.width, camera.height
    u, v = (np.linspace(0.5, side - 0.5, 100) for side in (width, height))
    first, last_u, last_v = np.full(100, 0.5), np.full(100, width - 0.5), np.full(100, height - 0.5)
    border = np.stack([np.concatenate([u, u, first, last_u]), np.concatenate([first, last_v, v, v])], axis=1)
    focal = (camera.focal_length_x + camera.focal_length_y) / 2

    def at_zoom(zoom: float) -> Camera:
        return Camera(width, height, zoom * focal, zoom * focal, width / 2, height / 2)

    def covered(zoom: float) -> bool:
        source = _source_pixels(camera, at_zoom(zoom), border)
        low, high = source + offsets.min(0), source + offsets.max(0)
        inside = (low >= 0.5) & (high <= np.array([width, height]) - 0.5)
        return bool(np.isfinite(source).all() and inside.all())

    low, high = 0.5, 3.0
    # Some zoom above 1 is always covered, unless the principal point is outside of the image.
    for _ in range(40):
        middle = (low + high) / 2
        low, high = (low, middle) if covered(middle) else (middle, high)
    return at_zoom(high)
