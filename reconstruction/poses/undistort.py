"""From a camera with lens distortion to a pinhole camera, and images resampled to it."""

import cv2
import numpy as np

from reconstruction.core.types import Camera

_NEGLIGIBLE_PX = 0.3  # a smaller displacement everywhere is not worth the blur of resampling


def undistort(camera: object, image_sets: list[np.ndarray]) -> tuple[Camera, list[np.ndarray]]:
    """Return a pinhole camera of the same size that sees only what the images cover, and the images in it.

    Args:
        camera: pycolmap.Camera of the images.
        image_sets: uint8 arrays (n, h, w, 3), any number of them.
    """
    width, height = camera.width, camera.height
    fx, fy = camera.focal_length_x, camera.focal_length_y
    pinhole = Camera(width, height, fx, fy, camera.principal_point_x, camera.principal_point_y)
    pixels = _pixel_grid(width, height)
    if np.abs(_source_pixels(camera, pinhole, pixels) - pixels).max() <= _NEGLIGIBLE_PX:
        return pinhole, image_sets
    pinhole = _covering_pinhole(camera)
    source = _source_pixels(camera, pinhole, pixels).reshape(height, width, 2).astype(
        np.float32
    ) - np.float32(0.5)
    return pinhole, [_resample(images, source) for images in image_sets]


def _resample(images: np.ndarray, source: np.ndarray) -> np.ndarray:
    out = np.empty_like(images)
    for row, image in enumerate(images):
        out[row] = cv2.remap(
            np.ascontiguousarray(image), source, None, cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REPLICATE
        )
    return out


def _pixel_grid(width: int, height: int) -> np.ndarray:
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    return np.stack([u, v], axis=-1).reshape(-1, 2)


def _source_pixels(camera: object, pinhole: Camera, pixels: np.ndarray) -> np.ndarray:
    """Return where each pixel (n, 2) of the pinhole image lies in the distorted one."""
    x = (pixels[:, 0] - pinhole.cx) / pinhole.fx
    y = (pixels[:, 1] - pinhole.cy) / pinhole.fy
    return np.asarray(camera.img_from_cam(np.stack([x, y, np.ones_like(x)], axis=1)))


def _covering_pinhole(camera: object) -> Camera:
    """Find the widest centered pinhole camera of the same size that sees only what the lens recorded."""
    width, height = camera.width, camera.height
    edge_u = np.concatenate(
        [np.linspace(0.5, width - 0.5, 100)] * 2 + [np.full(100, 0.5), np.full(100, width - 0.5)]
    )
    edge_v = np.concatenate(
        [np.full(100, 0.5), np.full(100, height - 0.5)] + [np.linspace(0.5, height - 0.5, 100)] * 2
    )
    edge = np.stack([edge_u, edge_v], axis=1)
    focal = (camera.focal_length_x + camera.focal_length_y) / 2

    def at_zoom(zoom: float) -> Camera:
        return Camera(width, height, zoom * focal, zoom * focal, width / 2, height / 2)

    def covered(zoom: float) -> bool:
        source = _source_pixels(camera, at_zoom(zoom), edge)
        inside = (source >= 0.5) & (source <= np.array([width, height]) - 0.5)
        return bool(np.isfinite(source).all() and inside.all())

    low, high = 0.5, 3.0
    # Above 1 there is always a zoom that is covered (unless the principal point is outside the image).
    for _ in range(40):
        middle = (low + high) / 2
        low, high = (low, middle) if covered(middle) else (middle, high)
    return at_zoom(high)
