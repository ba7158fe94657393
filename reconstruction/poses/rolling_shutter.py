"""Rolling shutter: rows are taken one after the other, so a moving camera has another pose at every row.

Each frame moves evenly during its readout, as between its neighbors in time. Observed points are moved to where a camera
with the pose of the middle row would see them, and the bundle is adjusted anew (Hedborg et al. 2012, with fixed motion).
The readout time is the one with the least reprojection error.
"""

from dataclasses import dataclass

import numpy as np

from reconstruction.core.progress import Progress
from reconstruction.poses.colmap_types import ColmapCamera, Reconstruction
from reconstruction.poses.mapping import poses_of
from reconstruction.poses.refine import bundle_adjust

_TRIED_S = (0.0, 0.016, 0.032)  # readout times of the parabola; phones have 5 to 35 ms
_LONGEST_S = 0.04
_MAX_GAP_S = 1.0  # between the neighbors in time that the motion of a frame comes from
_LOSS_SCALE_PX = 0.5  # as of the bundle adjustment


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


def project(camera: ColmapCamera, points: np.ndarray) -> np.ndarray:
    """Project points (k, 3) of camera space to pixels (k, 2); points behind the camera become NaN."""
    return np.asarray(camera.img_from_cam(points))


class Observations:
    """The observed points of a model, to be moved to the middle row and back."""

    def __init__(self, model: Reconstruction, times_s: np.ndarray, quarter_turns: int) -> None:
        """Keep the pixels as observed."""
        self.model, self.times_s, self.quarter_turns = model, times_s, quarter_turns
        self.rows = sorted(i - 1 for i in model.reg_image_ids())
        self.camera = model.cameras[min(model.cameras)]
        self.indices, self.pixels = {}, {}
        for row in self.rows:
            points = model.image(row + 1).points2D
            self.indices[row] = [k for k, p in enumerate(points) if p.has_point3D()]
            self.pixels[row] = np.array([points[k].xy for k in self.indices[row]]).reshape(-1, 2)

    def move(self, readout_s: float) -> None:
        """Put the observed points where the camera of the middle row sees them, for a readout time."""
        poses = poses_of(self.model)
        motion = Motion.of(self.times_s[self.rows], np.stack([poses[row] for row in self.rows]))
        size = self.camera.width, self.camera.height
        for number, row in enumerate(self.rows):
            points = self._in_camera(row, poses[row])
            when = row_times(self.pixels[row], size, readout_s, self.quarter_turns)
            seen = project(self.camera, moved(points, motion.angular[number], motion.linear[number], when))
            shift = np.nan_to_num(project(self.camera, points) - seen)
            image = self.model.image(row + 1)
            for index, pixel in zip(self.indices[row], self.pixels[row] + shift):
                image.point2D(index).xy = pixel

    def _in_camera(self, row: int, world_from_camera: np.ndarray) -> np.ndarray:
        image = self.model.image(row + 1)
        points = np.array(
            [self.model.point3D(image.point2D(k).point3D_id).xyz for k in self.indices[row]]
        ).reshape(-1, 3)
        return (points - world_from_camera[:3, 3]) @ world_from_camera[:3, :3]

    def cost(self) -> float:
        """Return the mean Cauchy loss of the reprojection errors, relative to its scale."""
        poses, total, count = poses_of(self.model), 0.0, 0
        for row in self.rows:
            image = self.model.image(row + 1)
            seen = project(self.camera, self._in_camera(row, poses[row]))
            given = np.array([image.point2D(k).xy for k in self.indices[row]]).reshape(-1, 2)
            error = ((seen - given) ** 2).sum(1)
            total += float(np.nansum(np.log1p(error / _LOSS_SCALE_PX**2)))
            count += len(error)
        return total / max(count, 1)
