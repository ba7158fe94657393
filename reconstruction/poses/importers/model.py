"""Build a COLMAP model from imported poses, and check that they fit the images."""

from pathlib import Path

import numpy as np

from reconstruction.core.types import FrameSet
from reconstruction.phone_exports.named_poses import ImportedPoses
from reconstruction.poses.colmap_types import Reconstruction
from reconstruction.poses.config import PosesConfig
from reconstruction.poses.features import Features
from reconstruction.poses.refine import drop_weak_frames, filter_points
from registry.errors import UsageError


def model_from_poses(
    imported: ImportedPoses, frames: FrameSet, features: list[Features], database_path: Path
) -> Reconstruction:
    """Return a model with the imported cameras and no points, to triangulate into."""
    import pycolmap

    model = pycolmap.Reconstruction()
    with pycolmap.Database.open(database_path) as database:
        for camera in database.read_all_cameras():
            model.add_camera(camera)
        for rig in database.read_all_rigs():
            model.add_rig(rig)
        names = {image.image_id: image for image in database.read_all_images()}
        for frame in database.read_all_frames():
            row = frame.frame_id - 1
            pose = imported.world_from_camera.get(int(frames.indices[row]))
            if pose is None:
                continue
            frame.rig_from_world = pycolmap.Rigid3d(np.linalg.inv(pose)[:3])
            model.add_frame(frame)
            image = pycolmap.Image(
                name=names[row + 1].name,
                keypoints=features[row].keypoints.astype(np.float64),
                camera_id=names[row + 1].camera_id,
                image_id=row + 1,
            )
            image.frame_id = frame.frame_id
            model.add_image(image)
            model.register_frame(frame.frame_id)
    return model


def check_consistency(model: Reconstruction, config: PosesConfig) -> None:
    """Filter the triangulated points; raise `UsageError` where too few are left, as the poses do not fit the images."""
    filter_points(model, config.max_point_error_px, config.min_track_length)
    if model.num_points3D() < 100:
        raise UsageError(
            f"poses: only {model.num_points3D()} points agree with the imported cameras; "
            "they do not fit these frames (wrong video, wrong frame numbers, or another axis convention)"
        )
    drop_weak_frames(model)
