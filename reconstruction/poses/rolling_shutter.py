"""Rolling shutter: rows are taken one after the other, so a moving camera has another pose at every row.

Each frame moves evenly during its readout, as between its neighbors in time. Observed points are moved to where a
camera with the pose of the middle row would see them, and the bundle is adjusted anew. The readout time is the one with
the least reprojection error.
"""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from reconstruction.core.progress import Progress
from reconstruction.core.types import FrameSet
from reconstruction.poses.colmap_types import ColmapCamera, Reconstruction
from reconstruction.poses.mapping import poses_of
from reconstruction.poses.observations import Observations, project, thinned
from reconstruction.poses.refine import bundle_adjust

_STEP_S = 0.016  # between readout times that are tried; phones have 5 to 35 ms
_MATTERS_PX = 0.5  # shift of the outer tenth of the points, in a quarter of the frames: the error of SIFT
_TYPICAL_S = 0.02  # readout time that the shift is judged by
_LEAST_S = 0.004  # shorter readouts move points by less than they are off
_LEAST_GAIN = 0.01  # of the cost; films without rolling shutter gain nothing
_LONGEST_S = 0.04
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


class ShutterObservations(Observations):
    """The observed points of a model, to be moved to the middle row and back."""

    def __init__(self, model: Reconstruction, times_s: np.ndarray, quarter_turns: int) -> None:
        """Keep the pixels as observed."""
        super().__init__(model)
        self.times_s, self.quarter_turns = times_s, quarter_turns

    def shifts(self, readout_s: float) -> list[np.ndarray]:
        """Return for each frame how far each point (k, 2) is from where the camera of the middle row sees it."""
        poses = poses_of(self.model)
        motion = Motion.of(self.times_s[self.rows], np.stack([poses[row] for row in self.rows]))
        size = self.camera.width, self.camera.height
        out = []
        for number, row in enumerate(self.rows):
            points = self.points_in_camera(row, poses[row])
            when = row_times(self.pixels[row], size, readout_s, self.quarter_turns)
            seen = project(self.camera, moved(points, motion.angular[number], motion.linear[number], when))
            out.append(np.nan_to_num(project(self.camera, points) - seen))
        return out

    def move(self, readout_s: float) -> None:
        """Put the observed points where the camera of the middle row sees them, for a readout time."""
        self.place({row: -shift for row, shift in zip(self.rows, self.shifts(readout_s))})


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


def correct_rolling_shutter(
    model: Reconstruction, frames: FrameSet, work_dir: Path, progress: Progress
) -> Shutter | None:
    """Estimate the readout time and adjust the model to it, in place; None where it does not matter or is not found."""
    observations = ShutterObservations(model, frames.times_s, frames.quarter_turns)
    largest = [np.quantile(np.hypot(*s.T), 0.9) for s in observations.shifts(_TYPICAL_S) if len(s)]
    if np.quantile(largest, 0.75) < _MATTERS_PX:
        return None
    readout_s, gain = _least_cost(model, frames, work_dir / "rolling_shutter")
    if readout_s < _LEAST_S or gain < _LEAST_GAIN:
        return None
    observations.move(readout_s)
    bundle_adjust(model)
    observations.move(readout_s)
    model.update_point_3d_errors()
    poses = poses_of(model)
    depth = [np.median(observations.points_in_camera(row, poses[row])[:, 2]) for row in observations.rows]
    times_s = frames.times_s[observations.rows]
    motion = Motion.of(times_s, np.stack([poses[row] for row in observations.rows]))
    progress.note(
        f"poses: rolling shutter of {1000 * readout_s:.0f} ms from the first row to the last, corrected"
    )
    return Shutter(readout_s, frames.quarter_turns, observations.camera, times_s, motion, np.array(depth))


def _least_cost(model: Reconstruction, frames: FrameSet, folder: Path) -> tuple[float, float]:
    """Return the readout time with the least cost, by a parabola, and what it gains relative to none."""
    import pycolmap

    thin = thinned(model, folder)
    thin.write(folder)
    costs: dict[int, float] = {}

    def cost(step: int) -> float:
        if step not in costs:
            trial = pycolmap.Reconstruction(folder)
            observations = ShutterObservations(trial, frames.times_s, frames.quarter_turns)
            observations.move(step * _STEP_S)
            bundle_adjust(trial)
            observations.move(step * _STEP_S)
            costs[step] = observations.cost()
        return costs[step]

    best = 0
    while (best + 1) * _STEP_S <= _LONGEST_S and cost(best + 1) < cost(best):
        best += 1
    low, middle, high = (cost(best + k) for k in (-1, 0, 1))
    offset = 0.5 * (low - high) / max(low - 2 * middle + high, 1e-12)
    readout_s = _STEP_S * (best + float(np.clip(offset, -0.5, 0.5)))
    # The parabola's minimum; between the steps it is not tried.
    least = middle - 0.25 * (low - high) * float(np.clip(offset, -0.5, 0.5))
    return readout_s, 1 - least / cost(0)
