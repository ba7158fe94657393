"""Cameras and pictures at the resolutions of the depth stage."""

import numpy as np

from reconstruction.core.types import Camera


def sized_camera(camera: Camera, side: int) -> Camera:
    """Return the camera at a resolution whose longer side is at most `side` pixels."""
    scale = min(1.0, side / max(camera.width, camera.height))
    return camera.resized(max(16, round(camera.width * scale)), max(16, round(camera.height * scale)))


def gray_images(images: np.ndarray, camera: Camera) -> np.ndarray:
    """Return float32 gray levels minus 128 (n, h, w) at the camera's resolution."""
    import cv2

    out = np.empty((len(images), camera.height, camera.width), np.float32)
    for i, image in enumerate(images):
        gray = cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY).astype(np.float32)
        out[i] = cv2.resize(gray, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    out -= 128.0
    return out


def small_color(image: np.ndarray, camera: Camera) -> np.ndarray:
    """Return a picture float32 (h, w, 3), 0 to 255, at the camera's resolution."""
    import cv2

    size = (camera.width, camera.height)
    return cv2.resize(np.ascontiguousarray(image), size, interpolation=cv2.INTER_AREA).astype(np.float32)
