"""What all readers of poses return."""

from dataclasses import dataclass

import numpy as np

# ARKit, nerfstudio and OpenGL: +x right, +y up, looking along -z.
OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True)
class NamedPoses:
    """What a reader finds: one lens, and a camera for each image name."""

    camera: object  # pycolmap.Camera at the size of the images
    named: list[tuple[str, np.ndarray]]  # image name, world_from_camera (4, 4) OpenCV; sorted by name
    metric: bool = False  # in metres
    roll_unknown: bool = False  # cameras may be turned by quarters about the optical axis
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class ImportedPoses:
    """Cameras by video frame number, and the lens that they share."""

    camera: object  # pycolmap.Camera at the size of the frames
    world_from_camera: dict[int, np.ndarray]  # float64 (4, 4) OpenCV
    metric: bool = False
    roll_unknown: bool = False
    notes: tuple[str, ...] = ()


def pinhole(fx: float, fy: float, cx: float, cy: float, width: int, height: int) -> object:
    """Return a pycolmap.Camera without distortion."""
    import pycolmap

    camera = pycolmap.Camera.create_from_model_name(1, "PINHOLE", fx, width, height)
    camera.params = [fx, fy, cx, cy]
    camera.has_prior_focal_length = True
    return camera
