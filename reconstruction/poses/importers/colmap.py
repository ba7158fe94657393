"""Read poses from a COLMAP model folder."""

from pathlib import Path

import numpy as np

from reconstruction.phone_exports.named_poses import NamedPoses
from registry.errors import UsageError


def read_colmap(path: Path) -> NamedPoses:
    """Read camera and images, without the points.

    Raises:
        UsageError: the model cannot be read, or its images use more than one camera.
    """
    import pycolmap

    try:
        model = pycolmap.Reconstruction(path)
    except (ValueError, RuntimeError, OSError) as error:
        raise UsageError(f"poses: the COLMAP model in {path} cannot be read: {error}") from error
    used = [model.image(i).camera_id for i in model.reg_image_ids()]
    if len(set(used)) != 1:
        raise UsageError(f"poses: {path} uses {len(set(used))} cameras; one camera for all frames is needed")
    named = []
    for image_id in sorted(model.reg_image_ids(), key=lambda i: model.image(i).name):
        camera_from_world = np.eye(4)
        camera_from_world[:3] = model.image(image_id).cam_from_world().matrix()
        named.append((model.image(image_id).name, np.linalg.inv(camera_from_world)))
    source = model.cameras[used[0]]
    camera = pycolmap.Camera.create_from_model_name(1, source.model_name, 1.0, source.width, source.height)
    camera.params = np.asarray(source.params).copy()
    camera.has_prior_focal_length = True
    return NamedPoses(camera, named)
