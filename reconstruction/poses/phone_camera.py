"""Correct a model for the camera of a phone: a crop that moves over the sensor, and a rolling shutter."""

from dataclasses import dataclass

import numpy as np
from threadpoolctl import threadpool_limits

from reconstruction.core.progress import Progress
from reconstruction.core.types import FrameSet
from reconstruction.poses.bundle import Bundle, Unknowns
from reconstruction.poses.colmap_types import Reconstruction
from reconstruction.poses.config import PosesConfig
from reconstruction.poses.keypoint_refinement import LOSS_SCALE_PX, adjust_to_patches
from reconstruction.poses.mapping import poses_of
from reconstruction.poses.moving_things import MOVING, clusters, without_moving_things
from reconstruction.poses.observations import Observations, project
from reconstruction.poses.refine import bundle_adjust
from reconstruction.poses.resection import resect
from reconstruction.poses.rolling_shutter import Motion, Shutter, moved, row_times
from reconstruction.poses.self_calibration import Calibration, self_calibrate

# In 36 generated films the spread is .5 pixels without a moving crop, and 2.4 and more where it moves by 1 % of the
# longer side; without a rolling shutter the readout is at most 2 ms.
_LEAST_SPREAD_PX = 1.0
_LEAST_READOUT_S = 0.004
# Influence and bend of a cluster, from which a film is said to have something large that moves. In four films in
# which somebody stays the largest bend was .25 to .37 %; in a film of a bedroom where all rests, a rack of clothes near
# the camera has an influence of 6.1 and bends the path by .025 %.
_SURELY_MOVING, _SURELY_BENT = 5.0, 0.001
_LEAST_GAIN = 0.01  # of the loss of the points that rest, by leaving out what moves


@dataclass(frozen=True)
class PhoneCamera:
    """A model that is adjusted to the camera of a phone, and how that camera differs from one at rest."""

    model: Reconstruction
    offsets: dict[int, np.ndarray] | None = None
    """(2,) in pixels of the principal point of each registered frame, by its row; None: the crop does not move."""
    shutter: Shutter | None = None
    """None: all rows are read at once."""


def find_phone_camera(
    model: Reconstruction, frames: FrameSet, config: PosesConfig, progress: Progress
) -> PhoneCamera:
    """Estimate the moving crop and the rolling shutter of a film, and adjust its model to them.

    Where they do not explain the film, what moves before the camera is looked for, and left out of the model. Then
    keypoints are aligned by patches (`keypoint_refinement`), and all is adjusted to them.

    Args:
        model: all frames share one camera; may be changed.
        frames: ordered; their times and the direction in which rows are read.
        config: which points are outliers.
        progress: receives notes.

    Returns:
        The adjusted model; its observed points are where a camera at rest with a fixed crop sees them.
    """
    with threadpool_limits(1, user_api="blas"):  # the number of threads changes the last bits
        model, calibration = _calibrated(model, frames, config, progress)
    moves = calibration.spread_px >= _LEAST_SPREAD_PX
    rolls = calibration.unknowns.readout_s >= _LEAST_READOUT_S
    # Only now: patches of what moves would bear each other out.
    model = adjust_to_patches(model, frames.images, config, progress)
    if not moves and not rolls:
        return PhoneCamera(model)
    bundle = Bundle(model, frames.times_s, frames.quarter_turns)
    with threadpool_limits(1, user_api="blas"):
        found = self_calibrate(bundle).unknowns
    readout_s = found.readout_s if rolls else 0.0
    observations = Observations(model)
    _take_over(found, bundle.rows, model)
    offsets = _offsets(found, bundle.rows, observations) if moves else None
    _place(observations, frames, offsets, readout_s)
    bundle_adjust(model, LOSS_SCALE_PX)
    motion = _place(observations, frames, offsets, readout_s)
    model.update_point_3d_errors()
    if offsets is not None:
        largest = max(float(np.linalg.norm(offset)) for offset in offsets.values())
        progress.note(
            f"poses: the film was stabilized by a crop that moves by up to {largest:.0f} pixels, corrected; a film "
            "without stabilization is better"
        )
    if not readout_s:
        return PhoneCamera(model, offsets)
    progress.note(
        f"poses: rolling shutter of {1000 * readout_s:.0f} ms from the first row to the last, corrected"
    )
    poses = poses_of(model)
    depth = [np.median(observations.points_in_camera(row, poses[row])[:, 2]) for row in observations.rows]
    times_s = frames.times_s[observations.rows]
    shutter = Shutter(readout_s, frames.quarter_turns, observations.camera, times_s, motion, np.array(depth))
    return PhoneCamera(model, offsets, shutter)


def _calibrated(
    model: Reconstruction, frames: FrameSet, config: PosesConfig, progress: Progress
) -> tuple[Reconstruction, Calibration]:
    """Return the model, without what moves where that fits better, and what was found of the camera."""
    first = Bundle(model, frames.times_s, frames.quarter_turns)
    at_first = self_calibrate(first)
    found = clusters(first, at_first)
    if max((c.influence for c in found), default=0.0) < MOVING:
        return model, at_first
    if (rest := without_moving_things(model, frames, config)) is not None:
        second = Bundle(rest, frames.times_s, frames.quarter_turns)
        at_second = self_calibrate(second)
        before, after = (b.losses_by_point(c.unknowns) for b, c in ((first, at_first), (second, at_second)))
        both = sorted(before.keys() & after.keys())
        if sum(after[i] for i in both) < (1 - _LEAST_GAIN) * sum(before[i] for i in both):
            lost = model.num_points3D() - rest.num_points3D()
            progress.note(
                f"poses: somebody or something moves before the camera; {lost} of {model.num_points3D()} points are "
                "left out. A film in which all rests is better"
            )
            return rest, at_second
    if any(c.influence > _SURELY_MOVING and c.bend > _SURELY_BENT for c in found):
        progress.note(
            "poses: parts of the scene do not agree with each other: something large moves before the camera, and "
            "could not be told from what rests. Cameras may be off; film while nothing moves"
        )
    return model, at_first


def _take_over(found: Unknowns, rows: list[int], model: Reconstruction) -> None:
    """Give a model the camera and the poses that were found."""
    import pycolmap

    model.cameras[min(model.cameras)].params = list(found.params)
    for row, turn, shift in zip(rows, found.turn, found.shift):
        frame = model.frame(model.image(row + 1).frame_id)
        frame.rig_from_world = pycolmap.Rigid3d(np.column_stack([turn, shift]))


def _offsets(found: Unknowns, rows: list[int], observations: Observations) -> dict[int, np.ndarray]:
    """Return the offset of each frame; of frames that took no part by resection."""
    offsets = dict(zip(rows, found.offset))
    poses = poses_of(observations.model)
    for row in set(observations.rows) - set(rows):
        points = observations.points_in_camera(row, poses[row])
        offsets[row] = resect(observations.camera, points, observations.pixels[row], np.zeros(2))
    return offsets


def _place(
    observations: Observations, frames: FrameSet, offsets: dict[int, np.ndarray] | None, readout_s: float
) -> Motion:
    """Put observed points where a camera at rest with a fixed crop sees them; return the motion of the frames."""
    poses, camera = poses_of(observations.model), observations.camera
    motion = Motion.of(frames.times_s[observations.rows], np.stack([poses[r] for r in observations.rows]))
    off = {}
    for number, row in enumerate(observations.rows):
        points = observations.points_in_camera(row, poses[row])
        size = camera.width, camera.height
        when = row_times(observations.pixels[row], size, readout_s, frames.quarter_turns)
        later = moved(points, motion.angular[number], motion.linear[number], when)
        off[row] = np.nan_to_num(project(camera, later) - project(camera, points))
        if offsets is not None:
            off[row] += offsets[row]
    observations.place(off)
    return motion
