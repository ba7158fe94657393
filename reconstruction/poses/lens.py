"""Where a pixel of the film as recorded lies in the straightened frames: measured on the frames themselves.

The poses stage hands on frames without lens distortion. A user clicks in the film as it is, so a click has to be
taken across. Both pictures of each keyframe are at hand: corners followed from one to the other give the map.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.optimize import least_squares

from reconstruction.core.types import FrameSet, PosedFrames
from registry.errors import InputError

_FRAMES, _CORNERS, _FEWEST = 10, 400, 60
_ROUNDS = 30  # of the fixed-point iteration that undoes the distortion


@dataclass(frozen=True)
class Lens:
    """The map from pixels of the frames as filmed to pixels of the straightened frames, at working size."""

    width: int
    height: int
    model: np.ndarray | None = (
        None  # float64 (8,) fx, fy, cx, cy, k1, k2, p1, p2 of the film's camera, seen from a
    )
    # straightened one with a focal length of its longer side and a central principal point; None: frames are as filmed

    @classmethod
    def measure(cls, filmed: FrameSet, posed: PosedFrames) -> "Lens":
        """Measure it on up to ten keyframes.

        Raises:
            InputError: the frames show too little to follow from one picture to the other.
        """
        rows = {int(index): row for row, index in enumerate(filmed.indices)}
        pairs = [(rows[int(index)], k) for k, index in enumerate(posed.indices) if int(index) in rows]
        height, width = posed.images.shape[1:3]
        chosen = [pairs[int(i)] for i in np.linspace(0, len(pairs) - 1, min(_FRAMES, len(pairs)))]
        if all(np.array_equal(filmed.images[a], posed.images[b]) for a, b in chosen):
            return cls(width, height)
        found = [_followed(np.asarray(filmed.images[a]), np.asarray(posed.images[b])) for a, b in chosen]
        before, after = (np.concatenate([f[k] for f in found]) for k in range(2))
        if len(before) < _FEWEST:
            raise InputError(
                f"the lens cannot be measured: only {len(before)} corners of the film are found again in its "
                "straightened frames. Address things by `id` or `at` instead of `pixel`."
            )
        rays = _rays(after, width, height)
        start = np.array([*_unit(width, height)[[0, 1, 0, 1], [0, 1, 2, 2]], 0, 0, 0, 0])
        fit = least_squares(
            lambda m: (_distorted(rays, m) - before).ravel(), start, loss="soft_l1", f_scale=0.2
        )
        return cls(width, height, fit.x)

    def straightened(self, pixels: np.ndarray) -> np.ndarray:
        """Return where pixels (n, 2) of a frame as filmed lie in the straightened frame; both at working size."""
        pixels = np.asarray(pixels, np.float64)
        if self.model is None:
            return pixels
        goal = (pixels - self.model[2:4]) / self.model[:2]
        pinhole = np.array([1, 1, 0, 0, *self.model[4:]])
        rays = goal.copy()
        for _ in range(_ROUNDS):
            rays += goal - _distorted(rays, pinhole)
        unit = _unit(self.width, self.height)
        return rays * unit[[0, 1], [0, 1]] + unit[:2, 2]

    def as_filmed(self, picture: np.ndarray) -> np.ndarray:
        """Return an id image (h, w) of a straightened frame, of any size, as the frame as filmed would show it."""
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


def _followed(filmed: np.ndarray, straight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return corners of one picture (n, 2) and where they are in the other; pixel centers at 0.5."""
    before, after = (cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in (filmed, straight))
    corners = cv2.goodFeaturesToTrack(before, _CORNERS, 0.01, 8)
    if corners is None:
        return np.zeros((0, 2)), np.zeros((0, 2))
    options = {"winSize": (21, 21), "maxLevel": 4}
    there, found, _ = cv2.calcOpticalFlowPyrLK(before, after, corners, None, **options)
    back, again, _ = cv2.calcOpticalFlowPyrLK(after, before, there, None, **options)
    good = (found & again)[:, 0].astype(bool) & (np.linalg.norm(back - corners, axis=2)[:, 0] < 0.3)
    return corners[good, 0].astype(np.float64) + 0.5, there[good, 0].astype(np.float64) + 0.5


def _unit(width: int, height: int) -> np.ndarray:
    """Return the matrix K of the straightened camera that the model is seen from."""
    side = float(max(width, height))
    return np.array([[side, 0, width / 2], [0, side, height / 2], [0, 0, 1]])


def _rays(pixels: np.ndarray, width: int, height: int) -> np.ndarray:
    unit = _unit(width, height)
    return (pixels - unit[:2, 2]) / unit[[0, 1], [0, 1]]


def _distorted(rays: np.ndarray, model: np.ndarray) -> np.ndarray:
    """Return the pixels (n, 2) in which the film's camera sees rays (n, 2): OpenCV's model with four coefficients."""
    fx, fy, cx, cy, k1, k2, p1, p2 = model
    x, y = rays.T
    square = x * x + y * y
    radial = 1 + k1 * square + k2 * square**2
    bent_x = x * radial + 2 * p1 * x * y + p2 * (square + 2 * x * x)
    bent_y = y * radial + p1 * (square + 2 * y * y) + 2 * p2 * x * y
    return np.stack([fx * bent_x + cx, fy * bent_y + cy], axis=1)
