"""The bundle adjustment of a film of one phone: its observations, unknowns, and normal equations.

COLMAP's adjustment has one principal point for all frames and one pose for all rows of a frame. This one has as
further unknowns the principal point of each frame and the readout time of the rolling shutter. It also gives the normal
equations of a part of the points, which `moving_things.py` needs. Names are those of Triggs et al., Bundle adjustment:
a modern synthesis, 2000.
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix
from scipy.spatial.transform import Rotation

from reconstruction.poses.colmap_types import Reconstruction
from reconstruction.poses.observations import derivatives, project
from reconstruction.poses.refine import LOSS_SCALE_PX
from reconstruction.poses.rolling_shutter import Motion, row_times

OF_FRAME = 8  # unknowns of a frame: turn, shift, offset of the principal point
OFFSET = np.array([6, 7])  # of these, the offset
_POINTS = 1500  # with the longest tracks, that take part
_FRAMES = 300  # most that take part: a step costs the cube of their number
_BEHIND_PX = 1e3  # error of a point behind the camera
_NO_DAMPING = 1e-9


@dataclass(frozen=True)
class Unknowns:
    """All that is adjusted; n frames, m points."""

    turn: np.ndarray  # float64 (n, 3, 3) camera_from_world
    shift: np.ndarray  # float64 (n, 3)
    offset: np.ndarray  # float64 (n, 2) pixels, of the principal point
    points: np.ndarray  # float64 (m, 3)
    params: np.ndarray  # float64 (p,) of the camera, as COLMAP orders them
    readout_s: float  # of the rolling shutter, from the first row to the last

    @property
    def centers(self) -> np.ndarray:
        """Return where the cameras are, (n, 3)."""
        return -np.einsum("nji,nj->ni", self.turn, self.shift)

    def motion(self, times_s: np.ndarray) -> Motion:
        """Return the velocity of each frame."""
        world_from_camera = np.tile(np.eye(4), (len(self.turn), 1, 1))
        world_from_camera[:, :3, :3] = self.turn.transpose(0, 2, 1)
        world_from_camera[:, :3, 3] = self.centers
        return Motion.of(times_s, world_from_camera)


@dataclass(frozen=True)
class Linear:
    """Errors (k, 2) of observations at some unknowns, and their derivatives by frame, shared unknowns and point."""

    frame: np.ndarray  # int64 (k,)
    point: np.ndarray  # int64 (k,)
    error: np.ndarray
    by_frame: np.ndarray  # (k, 2, OF_FRAME)
    by_shared: np.ndarray  # (k, 2, s) free parameters of the camera, then the readout time
    by_point: np.ndarray  # (k, 2, 3)

    def of(self, points: np.ndarray) -> "Linear":
        """Return the observations of some points, numbered anew."""
        number = np.full(int(self.point.max(initial=-1)) + 1, -1)
        number[points] = np.arange(len(points))
        own = number[self.point] >= 0
        parts = (self.error, self.by_frame, self.by_shared, self.by_point)
        return Linear(self.frame[own], number[self.point[own]], *(part[own] for part in parts))

    def losses(self) -> np.ndarray:
        """Return the Cauchy loss (k,) of each observation, relative to its scale."""
        return losses(self.error)


@dataclass(frozen=True)
class Equations:
    """Normal equations of c unknowns of cameras and m points: parts of the Hessian, and gradients."""

    cameras: np.ndarray  # (c, c)
    mixed: np.ndarray  # (c, 3 m)
    points: np.ndarray  # (m, 3, 3)
    gradient: np.ndarray  # (c,)
    of_points: np.ndarray  # (3 m,)

    @classmethod
    def of(cls, linear: Linear, frames: int, points: int) -> "Equations":
        """Return those of the observations of `frames` cameras and `points` points, weighted by the Cauchy loss."""
        shared = linear.by_shared.shape[2]
        root = 1 / np.sqrt(LOSS_SCALE_PX**2 + (linear.error**2).sum(1))[:, None, None]
        of_frame = OF_FRAME * linear.frame[:, None] + np.arange(OF_FRAME)
        of_all = np.broadcast_to(OF_FRAME * frames + np.arange(shared), (len(of_frame), shared))
        by_camera = root * np.concatenate([linear.by_frame, linear.by_shared], axis=2)
        by_point = root * linear.by_point
        left = _sparse(by_camera, np.hstack([of_frame, of_all]), OF_FRAME * frames + shared)
        right = _sparse(by_point, 3 * linear.point[:, None] + np.arange(3), 3 * points)
        error = (root[:, :, 0] * linear.error).ravel()
        own = np.zeros((points, 3, 3))
        np.add.at(own, linear.point, np.einsum("kij,kil->kjl", by_point, by_point))
        mixed = (left.T @ right).toarray()
        return cls((left.T @ left).toarray(), mixed, own, left.T @ error, right.T @ error)

    def reduced(self, damping: float = _NO_DAMPING) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the reduced camera system, matrix (c, c) and gradient (c,), and the points' inverses (m, 3, 3)."""
        own = np.einsum("mii->mi", self.points)
        inverse = np.linalg.inv(self.points + (damping * own + 1e-12)[:, :, None] * np.eye(3))
        through = np.einsum("cmj,mjk->cmk", self.mixed.reshape(len(self.mixed), -1, 3), inverse)
        through = through.reshape(self.mixed.shape)
        return self.cameras - through @ self.mixed.T, self.gradient - through @ self.of_points, inverse


class Bundle:
    """Observations of the points of a model with the longest tracks, and the first values of all unknowns."""

    def __init__(self, model: Reconstruction, times_s: np.ndarray, quarter_turns: int) -> None:
        """Collect them.

        Args:
            model: all frames share one camera; stays unchanged.
            times_s: of all frames, by row.
            quarter_turns: as of `row_times`.
        """
        import pycolmap

        registered = sorted(i - 1 for i in model.reg_image_ids())
        chosen = np.linspace(0, len(registered) - 1, min(len(registered), _FRAMES)).round().astype(int)
        self.rows = [registered[k] for k in chosen]
        self.times_s = np.asarray(times_s, np.float64)[self.rows]
        self._camera = pycolmap.Camera(model.cameras[min(model.cameras)].todict())
        self.free_params = [*self._camera.focal_length_idxs(), *self._camera.extra_params_idxs()]
        by_length = sorted(model.point3D_ids(), key=lambda i: (-model.point3D(i).track.length(), i))
        self.point_ids = by_length[:_POINTS]
        frame = {row + 1: k for k, row in enumerate(self.rows)}
        seen = [
            (frame[e.image_id], k, *model.image(e.image_id).point2D(e.point2D_idx).xy)
            for k, point_id in enumerate(self.point_ids)
            for e in model.point3D(point_id).track.elements
            if e.image_id in frame
        ]
        table = np.array(seen, np.float64).reshape(-1, 4)
        self.frame, self.point, self.pixel = table[:, 0].astype(int), table[:, 1].astype(int), table[:, 2:]
        size = self._camera.width, self._camera.height
        self._row_share = row_times(self.pixel, size, 1.0, quarter_turns)
        poses = np.array([model.image(row + 1).cam_from_world().matrix() for row in self.rows])
        self.start = Unknowns(
            poses[:, :, :3], poses[:, :, 3], np.zeros((len(self.rows), 2)),
            np.array([model.point3D(i).xyz for i in self.point_ids]), np.array(self._camera.params), 0.0,
        )  # fmt: skip

    def errors(self, at: Unknowns) -> np.ndarray:
        """Return the reprojection errors (k, 2)."""
        pixel = self._project(at.params, self._in_camera(at)[0])
        return np.nan_to_num(pixel + at.offset[self.frame] - self.pixel, nan=_BEHIND_PX)

    def losses_by_point(self, at: Unknowns) -> dict[int, float]:
        """Return the mean Cauchy loss of the observations of each point, by its id."""
        count = len(self.point_ids)
        total = np.bincount(self.point, losses(self.errors(at)), count)
        return dict(zip(self.point_ids, total / np.maximum(np.bincount(self.point, minlength=count), 1)))

    def linearized(self, at: Unknowns) -> Linear:
        """Return errors and derivatives (central differences) at `at`; points behind the camera have no derivative."""
        points, velocity = self._in_camera(at)
        error = self._project(at.params, points) + at.offset[self.frame] - self.pixel
        by_frame = derivatives(self._camera, points)
        by_place = by_frame[:, :, 3:6]
        shared = [self._by_param(at.params, index, points) for index in self.free_params]
        shared.append(np.einsum("kij,kj->ki", by_place, self._row_share[:, None] * velocity))
        parts = by_frame, np.stack(shared, axis=2), by_place @ at.turn[self.frame]
        seen = np.logical_and(np.isfinite(error).all(1), np.isfinite(by_place).all(axis=(1, 2)))
        parts = [np.where(seen[:, None, None], part, 0.0) for part in parts]
        return Linear(self.frame, self.point, np.where(seen[:, None], error, _BEHIND_PX), *parts)

    def stepped(self, at: Unknowns, of_cameras: np.ndarray, of_points: np.ndarray) -> Unknowns:
        """Return the unknowns after a step (c,) of the cameras and (m, 3) of the points."""
        frames = len(at.turn)
        of_frame, shared = np.split(of_cameras, [OF_FRAME * frames])
        of_frame = of_frame.reshape(frames, OF_FRAME)
        by = Rotation.from_rotvec(of_frame[:, :3]).as_matrix()
        params = at.params.copy()
        params[self.free_params] += shared[:-1]
        return Unknowns(
            by @ at.turn,
            np.einsum("nij,nj->ni", by, at.shift) + of_frame[:, 3:6],
            at.offset + of_frame[:, OFFSET],
            at.points + of_points,
            params,
            at.readout_s + float(shared[-1]),
        )

    def _in_camera(self, at: Unknowns) -> tuple[np.ndarray, np.ndarray]:
        """Return the observed points (k, 3) as the camera of their row sees them, and their velocity there (k, 3)."""
        motion = at.motion(self.times_s)
        still = np.einsum("kij,kj->ki", at.turn[self.frame], at.points[self.point]) + at.shift[self.frame]
        velocity = -motion.linear[self.frame] - np.cross(motion.angular[self.frame], still)
        return still + (at.readout_s * self._row_share)[:, None] * velocity, velocity

    def _project(self, params: np.ndarray, points: np.ndarray) -> np.ndarray:
        self._camera.params = list(params)
        return project(self._camera, points)

    def _by_param(self, params: np.ndarray, index: int, points: np.ndarray) -> np.ndarray:
        """Return the derivative (k, 2) of pixels by a parameter of the camera."""
        change = np.zeros(len(params))
        change[index] = 1e-4 * max(abs(float(params[index])), 1e-2)
        ahead, back = (self._project(params + sign * change, points) for sign in (1, -1))
        return (ahead - back) / (2 * change[index])


def losses(error: np.ndarray) -> np.ndarray:
    """Return the Cauchy loss (k,) of errors (k, 2), relative to its scale."""
    return 0.5 * np.log1p((error**2).sum(1) / LOSS_SCALE_PX**2)


def _sparse(values: np.ndarray, columns: np.ndarray, width: int) -> csr_matrix:
    """Return the Jacobian (2 k, width) of values (k, 2, c) that stand in columns (k, c)."""
    count, _, each = values.shape
    starts = np.arange(0, 2 * count * each + 1, each)
    return csr_matrix((values.ravel(), np.repeat(columns, 2, axis=0).ravel(), starts), (2 * count, width))
