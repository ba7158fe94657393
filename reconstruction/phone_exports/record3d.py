"""Read poses from Record3D: `metadata` (JSON) beside `rgb/` or `rgbd/`, in a folder or an `.r3d` file."""

import numpy as np

from reconstruction.phone_exports.exports import Export
from reconstruction.phone_exports.named_poses import OPENGL_FROM_OPENCV, NamedPoses, check_numbers, pinhole
from registry.errors import InputError


def read_record3d(export: Export) -> NamedPoses:
    """Read the poses of a recording with the rear (LiDAR) camera.

    They are in metres, relative to the first frame, so gravity is unknown. Versions of the app differ in the roll of a
    camera held upright, so the roll is determined from the images (`roll_unknown`).

    Raises:
        InputError: the metadata is malformed, or the camera does not move.
    """
    data = export.read_json(export.cameras)
    try:
        rows = np.array(data["poses"], np.float64).reshape(-1, 7)
        lens = _lens(data)
        width, height = int(data["w"]), int(data["h"])
        poses = _matrices(rows)
        check_numbers(lens, width, height, poses)
    except (KeyError, TypeError, ValueError, IndexError, OverflowError) as error:
        why = f"{type(error).__name__} {error}"
        raise InputError(
            f"poses: {export.cameras} in {export.path} is no Record3D metadata ({why})"
        ) from error
    if len(rows) < 2 or np.abs(rows - rows[0]).max() < 1e-9:
        raise InputError(
            f"poses: {export.path} has no camera motion: Record3D tracks only the rear (LiDAR) camera. Give the "
            "video alone, then the poses are estimated"
        )
    stems = {name: name.rsplit("/", 1)[-1].split(".")[0] for name in export.images}
    numbers = {
        name: int(stem)
        for name, stem in stems.items()
        if stem.isascii() and stem.isdigit() and len(stem) < 10
    }
    named = [(name, poses[i] @ OPENGL_FROM_OPENCV) for name, i in numbers.items() if i < len(poses)]
    return NamedPoses(pinhole(*lens, width, height), named, metric=True, roll_unknown=True)


def _matrices(rows: np.ndarray) -> np.ndarray:
    """Return the poses (n, 4, 4) of rows (n, 7): quaternion x, y, z, w and position."""
    from scipy.spatial.transform import Rotation

    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    if len(rows):
        poses[:, :3, :3] = Rotation.from_quat(rows[:, :4]).as_matrix()
        poses[:, :3, 3] = rows[:, 4:]
    return poses


def _lens(data: dict) -> tuple[float, float, float, float]:
    """Return fx, fy, cx, cy: the median of per-frame intrinsics (autofocus) where there are any, else those of K."""
    if data.get("perFrameIntrinsicCoeffs"):
        per_frame = np.array(data["perFrameIntrinsicCoeffs"], np.float64)
        fx, fy, cx, cy = np.median(per_frame[:, :4], axis=0).tolist()
        return fx, fy, cx, cy
    k = np.array(data["K"], np.float64).reshape(3, 3).T  # stored in column-major order
    return float(k[0, 0]), float(k[1, 1]), float(k[0, 2]), float(k[1, 2])
