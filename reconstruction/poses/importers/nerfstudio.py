"""Read poses from a nerfstudio `transforms.json`."""

import json
from pathlib import Path

import numpy as np

from reconstruction.phone_exports.named_poses import OPENGL_FROM_OPENCV, NamedPoses, check_numbers
from registry.errors import EnvironmentMissing, UsageError


def read_transforms(path: Path) -> NamedPoses:
    """Read intrinsics and poses.

    Raises:
        UsageError: the file is malformed, focal lengths differ, or k3 or k4 is used.
    """
    import pycolmap

    try:
        data = json.loads(path.read_text())
        listed = data["frames"]
        lens = {**(listed[0] if listed else {}), **data}
        width, height = int(lens["w"]), int(lens["h"])
        fx = float(lens["fl_x"]) if "fl_x" in lens else width / 2 / np.tan(float(lens["camera_angle_x"]) / 2)
        defaults = {"fl_y": fx, "cx": width / 2, "cy": height / 2, "k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0}
        params = [fx, *(float(lens.get(key, default)) for key, default in defaults.items())]
        named = []
        for frame in sorted(listed, key=lambda f: f["file_path"]):
            if abs(float(frame.get("fl_x", fx)) - fx) > 0.01 * fx:
                raise UsageError(f"poses: {path} has frames with different focal lengths; one lens is needed")
            world_from_opengl = np.array(frame["transform_matrix"], np.float64).reshape(4, 4)
            if not isinstance(frame["file_path"], str):
                raise TypeError(f"file_path {frame['file_path']!r} is no text")
            named.append((frame["file_path"], world_from_opengl @ OPENGL_FROM_OPENCV))
        poses = np.array([pose for _, pose in named]).reshape(-1, 4, 4)
        check_numbers(params, width, height, poses)
        higher = [float(lens.get(key, 0.0)) for key in ("k3", "k4")]
    except PermissionError as error:
        raise EnvironmentMissing(f"poses: {path}: {error.strerror}. Make it readable (chmod u+r)") from error
    except (
        KeyError, TypeError, ValueError, IndexError, AttributeError, ArithmeticError, RecursionError, OSError,
    ) as error:  # fmt: skip
        if isinstance(error, UsageError):
            raise
        why = f"{type(error).__name__} {error}"
        raise UsageError(f"poses: {path} is not a usable transforms.json: {why}") from error
    if not all(abs(value) <= 1e-9 for value in higher):
        raise UsageError(f"poses: {path} has k3 or k4 distortion; only k1, k2, p1 and p2 are supported")
    camera = pycolmap.Camera.create_from_model_name(1, "OPENCV", params[0], width, height)
    camera.params = params
    camera.has_prior_focal_length = True
    return NamedPoses(camera, named)
