"""Rolling shutter: rows are taken one after the other, so a moving camera has another pose at every row.

Each frame moves evenly during its readout, as between its neighbors in time. `self_calibration.py` estimates the
readout time; images are resampled to the poses of their middle rows.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from reconstruction.poses.colmap_types import ColmapCamera
from reconstruction.poses.observations import project

_MAX_GAP_S = 1.0  # between the neighbors in time that the motion of a frame comes from


@dataclass(frozen=True)
class Motion:
    """Velocity of each frame, in its own camera space."""

    angular: np.ndarray  # float64 (n, 3) rad/s
    linear: np.ndarray  # float64 (n, 3) units/s

    @classmethod
    def of(cls, times_s: np.ndarray, world_from_camera: np.ndarray) -> "Motion":
        """Return the mean velocities between each frame's neighbors; 0 where those are far in time."""
        from scipy.spatial.transform import Rotation

        rows = np.arange(len(times_s))
        before, after = np.maximum(rows - 1, 0), np.minimum(rows + 1, len(rows) - 1)
        gap = times_s[after] - times_s[before]
        used = (gap > 0) & (gap <= _MAX_GAP_S)
        share = np.where(used, 1 / np.maximum(gap, 1e-9), 0.0)[:, None]
        turn = world_from_camera[before, :3, :3].transpose(0, 2, 1) @ world_from_camera[after, :3, :3]
        way = world_from_camera[after, :3, 3] - world_from_camera[before, :3, 3]
        own = world_from_camera[:, :3, :3].transpose(0, 2, 1)
        return cls(Rotation.from_matrix(turn).as_rotvec() * share, np.einsum("nij,nj->ni", own, way) * share)


def moved(points: np.ndarray, angular: np.ndarray, linear: np.ndarray, time_s: np.ndarray) -> np.ndarray:
    """Return points (k, 3) of camera space as the camera sees them `time_s` (k,) later."""
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_rotvec(-time_s[:, None] * angular)
    return turn.apply(points - time_s[:, None] * linear)


def row_times(pixels: np.ndarray, size: tuple[int, int], readout_s: float, quarter_turns: int) -> np.ndarray:
    """Return when pixels (k, 2) are read, seconds from the middle.

    Args:
        pixels: in upright frames.
        size: width and height of upright frames.
        readout_s: time from the first row to the last.
        quarter_turns: counter-clockwise, from the frames as stored, whose rows are read from the top, to upright.
    """
    x, y = pixels[:, 0] / size[0] - 0.5, pixels[:, 1] / size[1] - 0.5
    return readout_s * (y, x, -y, -x)[quarter_turns % 4]


@dataclass(frozen=True)
class Shutter:
    """The rolling shutter of a film, and the motion and depth of its registered keyframes."""

    readout_s: float
    quarter_turns: int
    camera: ColmapCamera
    times_s: np.ndarray  # float64 (n,)
    motion: Motion
    depth: np.ndarray  # float64 (n,) median of the points in view

    def straightened(self, images: np.ndarray, times_s: np.ndarray) -> np.ndarray:
        """Resample images uint8 (m, h, w, 3), taken at `times_s`, to the poses of their middle rows.

        Motion and depth are those of the keyframe nearest in time. The depth of a frame is taken to be its median.
        """
        out = np.empty_like(images)
        height, width = images.shape[1:3]
        u, v = np.meshgrid(np.arange(0, width + 8, 8) + 0.5, np.arange(0, height + 8, 8) + 0.5)
        pixels = np.column_stack([u.ravel(), v.ravel()])
        rays = np.column_stack([np.asarray(self.camera.cam_from_img(pixels)), np.ones(len(pixels))])
        for number, time_s in enumerate(times_s):
            row = int(np.argmin(np.abs(self.times_s - time_s)))
            source = pixels
            for _ in range(2):  # the row that shows a point depends on where the point is
                when = row_times(source, (width, height), self.readout_s, self.quarter_turns)
                points = moved(
                    self.depth[row] * rays, self.motion.angular[row], self.motion.linear[row], when
                )
                source = np.nan_to_num(project(self.camera, points))
            shift = (source - pixels).reshape(*u.shape, 2).astype(np.float32)
            out[number] = _shifted(images[number], shift)
        return out


def _shifted(image: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """Resample an image by shifts (rows, columns, 2) given at every eighth pixel."""
    height, width = image.shape[:2]
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    dense = cv2.remap(shift, x / 8, y / 8, cv2.INTER_LINEAR)
    pixels, mode = np.ascontiguousarray(image), cv2.BORDER_REPLICATE
    return cv2.remap(pixels, x + dense[..., 0], y + dense[..., 1], cv2.INTER_LANCZOS4, borderMode=mode)
