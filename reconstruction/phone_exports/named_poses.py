"""Poses by image name, as readers return them, and by video frame number."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import pycolmap

# Camera axes of ARKit, nerfstudio and OpenGL: +x right, +y up, -z forward.
_LARGEST_PX = 100_000
OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True)
class NamedPoses:
    """Result of a reader: shared intrinsics, and one pose per image name."""

    camera: "pycolmap.Camera"  # at the size of the images
    named: list[tuple[str, np.ndarray]]  # image name, world_from_camera (4, 4) OpenCV; sorted by name
    metric: bool = False  # poses are in metres
    roll_unknown: bool = False  # all cameras may be turned by a multiple of 90 degrees about the optical axis
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class ImportedPoses:
    """Poses by video frame number and the shared intrinsics; flags as in `NamedPoses`."""

    camera: "pycolmap.Camera"  # at the size of the frames
    world_from_camera: dict[int, np.ndarray]  # float64 (4, 4) OpenCV
    metric: bool = False
    roll_unknown: bool = False
    notes: tuple[str, ...] = ()


def check_numbers(lens: Sequence[float], width: int, height: int, poses: np.ndarray) -> None:
    """Check intrinsics (fx, fy, cx, cy ... in pixels), a size in pixels, and poses (n, 4, 4), as read from a file.

    Raises:
        ValueError: a number is not finite or impossible, or a pose is not rigid; the message says which.
    """
    if not (1 <= width <= _LARGEST_PX and 1 <= height <= _LARGEST_PX):
        raise ValueError(f"images of {width}x{height} pixels")
    if not np.isfinite(lens).all() or not all(0 < focal < 100 * _LARGEST_PX for focal in lens[:2]):
        raise ValueError(f"a lens with the focal lengths {lens[0]:g} and {lens[1]:g}")
    if not np.isfinite(poses).all() or np.abs(poses).max(initial=0) > 1e6:
        raise ValueError("a pose with numbers that are not finite, or too large")
    turns = poses[:, :3, :3]
    if len(poses) and np.abs(turns @ turns.transpose(0, 2, 1) - np.eye(3)).max() > 0.05:
        raise ValueError("a pose that is no rotation and shift")


def pinhole(fx: float, fy: float, cx: float, cy: float, width: int, height: int) -> "pycolmap.Camera":
    """Return a pinhole camera; all arguments in pixels."""
    import pycolmap

    camera = pycolmap.Camera.create_from_model_name(1, "PINHOLE", fx, width, height)
    camera.params = [fx, fy, cx, cy]
    camera.has_prior_focal_length = True
    return camera
