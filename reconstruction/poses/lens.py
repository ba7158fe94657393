"""Map pixels between the video as recorded and its undistorted frames.

The poses stage returns undistorted frames, without the distorted camera, but users click in the video. The distortion
is therefore fitted to corners tracked from keyframes as recorded to their undistorted versions.
"""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from scipy.optimize import least_squares

from reconstruction.core.types import Camera, FrameSet, PosedFrames
from registry.errors import InputError

_FRAMES, _CORNERS = 10, 400  # most frames, most corners in each
_FEWEST = 60  # tracked corners that the fit needs
_ROUNDS = 30  # fixed-point iterations that invert the distortion


@dataclass(frozen=True)
class Lens:
    """The map between pixels of the frames as recorded and of the undistorted frames, at working size."""

    width: int
    height: int
    # float64 (8,) fx, fy, cx, cy, k1, k2, p1, p2 of the recording camera, for rays of `_pinhole`; None: not distorted
    model: np.ndarray | None = None

    @classmethod
    def measure(cls, filmed: FrameSet, posed: PosedFrames) -> "Lens":
        """Fit the distortion to corners tracked in up to ten keyframes, by robust least squares.

        Raises:
            InputError: too few corners can be tracked.
        """
        rows = {int(index): row for row, index in enumerate(filmed.indices)}
        pairs = [(rows[int(index)], k) for k, index in enumerate(posed.indices) if int(index) in rows]
        height, width = posed.images.shape[1:3]
        chosen = [pairs[int(i)] for i in np.linspace(0, len(pairs) - 1, min(_FRAMES, len(pairs)))]
        if all(np.array_equal(filmed.images[a], posed.images[b]) for a, b in chosen):
            return cls(width, height)
        found = [_tracked_corners(filmed.images[a], posed.images[b]) for a, b in chosen]
        before, after = (np.concatenate([f[k] for f in found]) for k in range(2))
        if len(before) < _FEWEST:
            raise InputError(
                f"the lens distortion cannot be measured: only {len(before)} corners can be tracked from the video to "
                "its undistorted frames. Address objects by `id` or `at` instead of `pixel`."
            )
        pinhole = _pinhole(width, height)
        rays = pinhole.unproject(after[:, 0], after[:, 1], np.ones(len(after)))[:, :2]
        start = np.array([*pinhole.intrinsics, 0, 0, 0, 0])

        def residuals(model: np.ndarray) -> np.ndarray:
            return (_distorted(rays, model) - before).ravel()

        return cls(width, height, least_squares(residuals, start, loss="soft_l1", f_scale=0.2).x)

    def straightened(self, pixels: np.ndarray) -> np.ndarray:
        """Map pixels (n, 2) of a frame as recorded to the undistorted frame; both at working size."""
        pixels = np.asarray(pixels, np.float64)
        if self.model is None:
            return pixels
        goal = (pixels - self.model[2:4]) / self.model[:2]
        normalized = np.array([1, 1, 0, 0, *self.model[4:]])
        rays = goal.copy()
        for _ in range(_ROUNDS):
            rays += goal - _distorted(rays, normalized)
        points = np.column_stack([rays, np.ones(len(rays))])
        return np.stack(_pinhole(self.width, self.height).project(points), axis=1)

    def as_filmed(self, picture: np.ndarray) -> np.ndarray:
        """Resample an id image (h, w) of an undistorted frame, of any size, to the frame as recorded; 0 outside."""
        if self.model is None:
            return np.asarray(picture)
        height, width = picture.shape
        scale = np.array([self.width / width, self.height / height])
        grid = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=-1)
        source = self.straightened(grid.reshape(-1, 2) * scale) / scale
        column, row = np.floor(source).astype(np.int64).T
        inside = (column >= 0) & (row >= 0) & (column < width) & (row < height)
        out = np.zeros(width * height, picture.dtype)
        out[inside] = np.asarray(picture)[row[inside], column[inside]]
        return out.reshape(height, width)


def _tracked_corners(filmed: np.ndarray, straight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Track corners by optical flow, checked backwards: pixels (n, 2) in both images, pixel centers at 0.5."""
    before, after = (cv2.cvtColor(np.asarray(image), cv2.COLOR_RGB2GRAY) for image in (filmed, straight))
    corners = cv2.goodFeaturesToTrack(before, _CORNERS, 0.01, 8)
    if corners is None:
        return np.zeros((0, 2)), np.zeros((0, 2))
    options: Any = {"winSize": (21, 21), "maxLevel": 4, "nextPts": None}
    there, found, _ = cv2.calcOpticalFlowPyrLK(before, after, corners, **options)
    back, again, _ = cv2.calcOpticalFlowPyrLK(after, before, there, **options)
    good = (found[:, 0] != 0) & (again[:, 0] != 0) & (np.linalg.norm(back - corners, axis=2)[:, 0] < 0.3)
    return corners[good, 0].astype(np.float64) + 0.5, there[good, 0].astype(np.float64) + 0.5


def _pinhole(width: int, height: int) -> Camera:
    """Return the nominal camera of the undistorted frames: centered, its focal length the longer side."""
    side = float(max(width, height))
    return Camera(width, height, side, side, width / 2, height / 2)


def _distorted(rays: np.ndarray, model: np.ndarray) -> np.ndarray:
    """Project rays (n, 2) at z = 1 to pixels (n, 2) by OpenCV's camera model with k1, k2, p1, p2."""
    fx, fy, cx, cy, k1, k2, p1, p2 = model
    x, y = rays.T
    square = x * x + y * y
    radial = 1 + k1 * square + k2 * square**2
    bent_x = x * radial + 2 * p1 * x * y + p2 * (square + 2 * x * x)
    bent_y = y * radial + p1 * (square + 2 * y * y) + 2 * p2 * x * y
    return np.stack([fx * bent_x + cx, fy * bent_y + cy], axis=1)
