"""Read poses from Polycam's raw data: one JSON file per keyframe, in ARKit's world (+y up, metres)."""

from pathlib import PurePosixPath

import numpy as np

from reconstruction.phone_exports.exports import Export, turned_camera, upright_turns
from reconstruction.phone_exports.named_poses import OPENGL_FROM_OPENCV, NamedPoses, check_numbers, pinhole
from registry.errors import InputError

_MAX_FOCAL_SPREAD = 0.03  # relative deviation from the median; autofocus causes less
_LENS = ("fx", "fy", "cx", "cy")


def read_polycam(export: Export) -> NamedPoses:
    """Read the poses of the images turned upright (see `polycam_turns`), and the median intrinsics.

    Raises:
        InputError: a camera file is malformed, or focal lengths vary too much.
    """
    stored, lenses, size = _read(export)
    lens = np.median(lenses, axis=0)
    spread = float(np.abs(lenses[:, :2] / lens[:2] - 1).max())
    if spread > _MAX_FOCAL_SPREAD:
        raise InputError(
            f"poses: the focal length varies by {100 * spread:.0f} % in {export.path}; one lens for all images is "
            "needed (no zoom, no change of lens)"
        )
    turns = upright_turns(np.stack(list(stored.values())))
    fx, fy, cx, cy = lens.tolist()
    width, height = size
    for _ in range(turns):
        fx, fy, cx, cy, width, height = fy, fx, cy, width - cx, height, width
    named = [(name, pose @ turned_camera(turns)) for name, pose in stored.items()]
    notes = ()
    if spread > 1e-3:
        notes = (f"poses: the focal length varies by {100 * spread:.1f} % (autofocus); its median is used",)
    return NamedPoses(pinhole(fx, fy, cx, cy, width, height), named, metric=True, notes=notes)


def polycam_turns(export: Export) -> int:
    """Return the quarter turns (`np.rot90`) that make the images upright; files have the sensor's orientation."""
    return upright_turns(np.stack(list(_read(export)[0].values())))


def _read(export: Export) -> tuple[dict[str, np.ndarray], np.ndarray, tuple[int, int]]:
    """Return world_from_camera (OpenCV) by image name, fx, fy, cx, cy float64 (n, 4), and (width, height)."""
    stored, lenses, size = {}, [], (0, 0)
    for name in export.images:
        file = f"{export.cameras}/{PurePosixPath(name).stem}.json"
        data = export.read_json(file)
        try:
            pose = np.eye(4)
            pose[:3] = [[float(data[f"t_{row}{column}"]) for column in range(4)] for row in range(3)]
            lenses.append([float(data[key]) for key in _LENS])
            size = (int(data["width"]), int(data["height"]))
            check_numbers(lenses[-1], *size, pose[None])
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            why = f"{type(error).__name__} {error}"
            raise InputError(f"poses: {file} in {export.path} is no Polycam camera ({why})") from error
        stored[name] = pose @ OPENGL_FROM_OPENCV
    return stored, np.array(lenses), size
