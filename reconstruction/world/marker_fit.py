"""Measure the side of a printed marker by direct image alignment over all views.

Corner detections are biased by a tenth of a pixel or two where code cells touch the corner, which is a percent of a
marker of 20 pixels. Therefore the known pattern, blurred as by a lens, is rendered as a square in space with seven
parameters (position, rotation, side), and Gauss-Newton minimizes its difference to the images. Gain and offset are free
in each view.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from reconstruction.core.types import PosedFrames

_TEXELS = 16  # of the rendered pattern, per cell
_MARGIN_CELLS = 0.5  # width of the white border that is compared as well
_MAX_VIEWS = 24
_MAX_PIXELS = 900  # per view
_BLURS_PX = (0.35, 0.6, 0.9, 1.3)  # candidates for the standard deviation of the blur
_STEPS = 8  # of Gauss-Newton
_STEP_PX = 0.15  # of the finite differences
_MIN_CORRELATION = 0.8  # of image and pattern, for a view to count
_GROUPS = 8  # of the jackknife
# Samples within a pixel, in standard deviations of the blur.
_TAPS = np.array([(x, y) for x in (-1.2, 0.0, 1.2) for y in (-1.2, 0.0, 1.2)])


@dataclass(frozen=True)
class Square:
    """A marker in `sfm` space; seen from its front, x is right and y down."""

    center: np.ndarray  # float64 (3,)
    axes: np.ndarray  # float64 (3, 3) columns x, y and normal
    side: float  # `sfm` units

    @classmethod
    def of_corners(cls, corners: np.ndarray) -> "Square":
        """Fit a square to four corners (4, 3): top left, top right, bottom right, bottom left."""
        center = corners.mean(axis=0)
        x = corners[1] + corners[2] - corners[0] - corners[3]
        y = corners[2] + corners[3] - corners[0] - corners[1]
        u, _, vt = np.linalg.svd(np.stack([x, y], axis=1), full_matrices=False)
        plane = u @ vt
        axes = np.column_stack([plane, np.cross(plane[:, 0], plane[:, 1])])
        return cls(center, axes, float(np.linalg.norm(corners - np.roll(corners, -1, axis=0), axis=1).mean()))

    def moved(self, step: np.ndarray) -> "Square":
        """Apply a step (7,): translation along its axes in sides, rotation vector in radians, log of the side."""
        turn = Rotation.from_rotvec(step[3:6]).as_matrix()
        center = self.center + self.side * self.axes @ step[:3]
        return Square(center, self.axes @ turn, self.side * float(np.exp(step[6])))


@dataclass(frozen=True)
class _View:
    """The pixels of one image that a marker covers."""

    values: np.ndarray  # float64 (p,) gray levels
    rays: np.ndarray  # float64 (p, t, 3) through the taps of each pixel, `sfm` space
    tap_weights: np.ndarray  # float64 (t,) sum 1
    eye: np.ndarray  # float64 (3,) camera center
    pixels: float  # side of the marker in the image


def fit_square(
    posed: PosedFrames, rows: list[int], start: Square, cells: np.ndarray
) -> tuple[Square, float, int] | None:
    """Align a square to the images of a marker.

    Args:
        posed: the frames.
        rows: frames that see the marker.
        start: the marker, accurate to a pixel or two.
        cells: uint8 (n, n) the printed cells with the black border, 0 black, 255 white.

    Returns:
        The square, the relative standard deviation of its side, and the number of views used; None if fewer than two
        views match the pattern.
    """
    pattern = _pattern(cells)
    views = [view for row in rows if (view := _best_blur(posed, row, start, pattern, len(cells))) is not None]
    views = sorted(views, key=lambda view: -view.pixels)[:_MAX_VIEWS]
    square = start
    for _ in range(2):
        if len(views) < 2:
            return None
        square = _descend(views, square, pattern, len(cells))
        scores = [_correlation(view, square, pattern, len(cells)) for view in views]
        views = [view for view, score in zip(views, scores) if score > _MIN_CORRELATION]
    if len(views) < 2:
        return None
    return square, _jackknife(views, square, pattern, len(cells)), len(views)


def _pattern(cells: np.ndarray) -> np.ndarray:
    """Return the print in [0, 1] at _TEXELS per cell, with a white border of two cells, slightly blurred."""
    padded = np.pad(cells.astype(np.float32) / 255.0, 2, constant_values=1.0)
    return cv2.GaussianBlur(padded.repeat(_TEXELS, 0).repeat(_TEXELS, 1), (0, 0), 0.06 * _TEXELS)


def _view(posed: PosedFrames, row: int, square: Square, cells: int, blur_px: float) -> _View | None:
    """Gather the pixels of one frame; None if the marker is not wholly in view."""
    camera, pose = posed.camera, posed.world_from_camera[row]
    reach = 0.5 + _MARGIN_CELLS / cells
    outline = reach * square.side * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0.0]])
    points = (square.center + outline @ square.axes.T - pose[:3, 3]) @ pose[:3, :3]
    if (points[:, 2] <= 0).any():
        return None
    quad = points[:, :2] / points[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    low, high = np.floor(quad.min(axis=0)).astype(int), np.ceil(quad.max(axis=0)).astype(int)
    if (low < 0).any() or high[0] > camera.width or high[1] > camera.height:
        return None
    inside = np.zeros((high - low)[::-1], np.uint8)
    cv2.fillConvexPoly(inside, np.rint(quad - low - 0.5).astype(np.int32), 1)
    v, u = np.nonzero(inside)
    stride = max(1, len(u) // _MAX_PIXELS)
    u, v = u[::stride] + low[0], v[::stride] + low[1]
    gray = np.asarray(posed.images[row]).astype(np.float64) @ [0.299, 0.587, 0.114]
    taps = _TAPS * blur_px
    at = np.stack([u, v], axis=1)[:, None] + 0.5 + taps
    local = camera.unproject(at[..., 0], at[..., 1], 1.0)
    weights = np.exp(-0.5 * (taps**2).sum(axis=1) / blur_px**2)
    side_px = float(np.sqrt(cv2.contourArea(quad.astype(np.float32)))) / (2 * reach)
    return _View(gray[v, u], local @ pose[:3, :3].T, weights / weights.sum(), pose[:3, 3], side_px)


def _drawn(view: _View, square: Square, pattern: np.ndarray, cells: int) -> np.ndarray:
    """Render the pattern at the view's pixels (p,)."""
    normal = square.axes[:, 2]
    depth = (square.center - view.eye) @ normal / (view.rays @ normal)
    on_plane = (view.eye + depth[..., None] * view.rays - square.center) @ square.axes[:, :2]
    texel = ((on_plane / square.side + 0.5) * cells + 2) * _TEXELS - 0.5
    flat = texel.reshape(-1, len(view.tap_weights), 2).astype(np.float32)
    looked = cv2.remap(
        pattern, flat[..., 0], flat[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=1.0
    )
    return looked.astype(np.float64) @ view.tap_weights


def _normalized(values: np.ndarray) -> np.ndarray:
    centred = values - values.mean()
    return centred / max(float(np.linalg.norm(centred)), 1e-9)


def _correlation(view: _View, square: Square, pattern: np.ndarray, cells: int) -> float:
    return float(_normalized(view.values) @ _normalized(_drawn(view, square, pattern, cells)))


def _best_blur(posed: PosedFrames, row: int, square: Square, pattern: np.ndarray, cells: int) -> _View | None:
    """Return the view of a frame with the blur that correlates best; None if the marker is too small or cut off."""
    views = [view for blur in _BLURS_PX if (view := _view(posed, row, square, cells, blur)) is not None]
    if not views or len(views[0].values) < 40:
        return None
    return max(views, key=lambda view: _correlation(view, square, pattern, cells))


def _descend(views: list[_View], square: Square, pattern: np.ndarray, cells: int) -> Square:
    """Take Gauss-Newton steps on all views together, until they are below 3e-5."""
    for _ in range(_STEPS):
        normal, right = np.zeros((7, 7)), np.zeros(7)
        for view in views:
            jacobian, residual = _linearized(view, square, pattern, cells)
            normal += jacobian.T @ jacobian
            right += jacobian.T @ residual
        step = np.linalg.solve(normal + 1e-6 * np.diag(np.diag(normal)), right)
        step *= min(1.0, 0.1 / max(float(np.abs(step).max()), 1e-12))
        square = square.moved(step)
        if np.abs(step).max() < 3e-5:
            break
    return square


def _linearized(
    view: _View, square: Square, pattern: np.ndarray, cells: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the Jacobian (p, 7) and the residual (p,), robustly weighted, with gain and offset projected out."""
    drawn = _drawn(view, square, pattern, cells)
    size = _STEP_PX / max(view.pixels, 1.0)
    jacobian = np.empty((len(drawn), 7))
    for n in range(7):
        step = np.zeros(7)
        step[n] = size
        jacobian[:, n] = (_drawn(view, square.moved(step), pattern, cells) - drawn) / size
    base = np.stack([np.ones(len(drawn)), drawn], axis=1)
    (offset, gain), *_ = np.linalg.lstsq(base, view.values, rcond=None)
    residual = (view.values - offset - gain * drawn) / max(gain, 1e-9)
    spread = max(1.4826 * float(np.median(np.abs(residual))), 1e-3)
    weight = np.sqrt(np.minimum(1.0, 2.0 * spread / np.maximum(np.abs(residual), 1e-12)))
    base, jacobian, residual = base * weight[:, None], jacobian * weight[:, None], residual * weight
    jacobian = jacobian - base @ np.linalg.lstsq(base, jacobian, rcond=None)[0]
    # Divide by the noise, which is the same in gray levels in every view.
    return jacobian / spread, residual / spread


def _jackknife(views: list[_View], square: Square, pattern: np.ndarray, cells: int) -> float:
    """Return the relative standard deviation of the side, by a jackknife over groups of views."""
    groups = min(_GROUPS, len(views))
    parts = []
    for view in views:
        jacobian, residual = _linearized(view, square, pattern, cells)
        parts.append((jacobian.T @ jacobian, jacobian.T @ residual))
    sides = []
    for group in range(groups):
        kept = [part for n, part in enumerate(parts) if n % groups != group]
        normal, right = (np.sum([part[k] for part in kept], axis=0) for k in (0, 1))
        sides.append(np.linalg.solve(normal + 1e-6 * np.diag(np.diag(normal)), right)[6])
    return float(np.sqrt((groups - 1) * np.var(sides)))
