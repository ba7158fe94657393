"""Poses by image name, as readers return them, and by video frame number."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import pycolmap

# Camera axes of ARKit, nerfstudio and OpenGL: +x right, +y up, -z forward.
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


def pinhole(fx: float, fy: float, cx: float, cy: float, width: int, height: int) -> "pycolmap.Camera":
    """Return a pinhole camera; all arguments in pixels."""
    import pycolmap

    camera = pycolmap.Camera.create_from_model_name(1, "PINHOLE", fx, width, height)
    camera.params = [fx, fy, cx, cy]
    camera.has_prior_focal_length = True
    return camera
