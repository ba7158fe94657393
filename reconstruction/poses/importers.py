"""Poses that the user already has: a COLMAP model folder or a nerfstudio `transforms.json`.

Images are told apart by file name. For a folder of images they are the names in that folder. For a video
either the import has one image per video frame (then name order is frame order), or the last number in a name
is the number of the video frame, from 0.
"""

import json
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from reconstruction.decoding import ImageFolder
from reconstruction.poses.config import PosesConfig
from reconstruction.poses.features import Features
from reconstruction.poses.refine import drop_weak_frames, filter_points
from reconstruction.types import FrameSet
from registry.errors import UsageError

# nerfstudio's cameras follow OpenGL: +x right, +y up, looking along -z.
_OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
_MIN_COMMON_FRAMES = 8


@dataclass(frozen=True)
class ImportedPoses:
    """Cameras by video frame number, and the lens that they share."""

    camera: object  # pycolmap.Camera at the size of the frames
    world_from_camera: dict[int, np.ndarray]  # float64 (4, 4) OpenCV


def read_poses(path: Path, frames: FrameSet) -> ImportedPoses:
    """Read poses and assign them to frames."""
    if path.is_dir() and (path / "transforms.json").is_file():
        path = path / "transforms.json"
    if path.is_file() and path.suffix == ".json":
        camera, named = _read_transforms(path)
    elif path.is_dir() and any((path / f"images{suffix}").is_file() for suffix in (".bin", ".txt")):
        camera, named = _read_colmap(path)
    else:
        raise UsageError(
            f"poses: {path} is neither a COLMAP model folder (cameras, images and points3D as .bin or .txt) "
            "nor a nerfstudio transforms.json"
        )
    numbers = _frame_numbers([name for name, _ in named], frames)
    height, width = frames.images.shape[1:3]
    if abs(width / height - camera.width / camera.height) > 0.02 * width / height:
        raise UsageError(
            f"poses: {path} is of {camera.width}x{camera.height} images, the frames are {width}x{height}: "
            "the shapes differ, so they are not of the same video"
        )
    camera.rescale(width, height)
    imported = ImportedPoses(camera, {number: pose for number, (_, pose) in zip(numbers, named)})
    common = sum(int(index) in imported.world_from_camera for index in frames.indices)
    if common < _MIN_COMMON_FRAMES:
        raise UsageError(
            f"poses: {path} has poses for {common} of the {len(frames.indices)} keyframes, at least "
            f"{_MIN_COMMON_FRAMES} are needed; is it of this video? Its names must hold video frame numbers "
            f"(first name: {named[0][0] if named else 'none'})"
        )
    return imported


def model_from_poses(
    imported: ImportedPoses, frames: FrameSet, features: list[Features], database_path: Path
) -> object:
    """Return a pycolmap.Reconstruction with the imported cameras and no points, to triangulate into."""
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


def check_consistency(model: object, config: PosesConfig) -> None:
    """Filter the triangulated points; raise `UsageError` where the poses do not fit the pictures."""
    filter_points(model, config.max_point_error_px, config.min_track_length)
    if model.num_points3D() < 100:
        raise UsageError(
            f"poses: only {model.num_points3D()} points agree with the cameras in {config.import_path}; "
            "they do not fit these frames (wrong video, wrong frame numbers, or another axis convention)"
        )
    drop_weak_frames(model)


def _read_colmap(path: Path) -> tuple[object, list[tuple[str, np.ndarray]]]:
    import pycolmap

    try:
        model = pycolmap.Reconstruction(path)
    except (ValueError, RuntimeError, OSError) as error:
        raise UsageError(f"poses: the COLMAP model in {path} cannot be read: {error}") from error
    used = [model.image(i).camera_id for i in model.reg_image_ids()]
    if len(set(used)) != 1:
        raise UsageError(
            f"poses: {path} has {len(set(used))} cameras in use; one camera for all frames is needed"
        )
    named = []
    for image_id in sorted(model.reg_image_ids(), key=lambda i: model.image(i).name):
        camera_from_world = np.eye(4)
        camera_from_world[:3] = model.image(image_id).cam_from_world().matrix()
        named.append((model.image(image_id).name, np.linalg.inv(camera_from_world)))
    source = model.cameras[used[0]]
    camera = pycolmap.Camera.create_from_model_name(1, source.model_name, 1.0, source.width, source.height)
    camera.params = np.asarray(source.params).copy()
    camera.has_prior_focal_length = True
    return camera, named


def _read_transforms(path: Path) -> tuple[object, list[tuple[str, np.ndarray]]]:
    import pycolmap

    try:
        data = json.loads(path.read_text())
        listed = data["frames"]
        lens = {**(listed[0] if listed else {}), **data}
        width, height = int(lens["w"]), int(lens["h"])
        fx = float(lens["fl_x"]) if "fl_x" in lens else width / 2 / np.tan(float(lens["camera_angle_x"]) / 2)
        params = [
            fx,
            float(lens.get("fl_y", fx)),
            float(lens.get("cx", width / 2)),
            float(lens.get("cy", height / 2)),
            *(float(lens.get(k, 0.0)) for k in ("k1", "k2", "p1", "p2")),
        ]
        named = []
        for frame in sorted(listed, key=lambda f: f["file_path"]):
            if abs(float(frame.get("fl_x", fx)) - fx) > 0.01 * fx:
                raise UsageError(f"poses: {path} has frames with different focal lengths; one lens is needed")
            world_from_opengl = np.array(frame["transform_matrix"], np.float64).reshape(4, 4)
            named.append((frame["file_path"], world_from_opengl @ _OPENGL_FROM_OPENCV))
    except (KeyError, TypeError, ValueError, IndexError, OSError) as error:
        if isinstance(error, UsageError):
            raise
        raise UsageError(
            f"poses: {path} is not a usable transforms.json: {type(error).__name__} {error}"
        ) from error
    if any(abs(float(lens.get(k, 0.0))) > 1e-9 for k in ("k3", "k4")):
        raise UsageError(f"poses: {path} has k3 or k4 distortion; only k1, k2, p1 and p2 are supported")
    camera = pycolmap.Camera.create_from_model_name(1, "OPENCV", params[0], width, height)
    camera.params = params
    camera.has_prior_focal_length = True
    return camera, named


def _frame_numbers(names: list[str], frames: FrameSet) -> list[int]:
    """Return the video frame number of each image name (sorted by name)."""
    source = Path(frames.source.file)
    if source.is_dir():
        # The same reading of the folder as in stage 1, so that order and left-out files agree.
        order = {path.name: number for number, path in enumerate(ImageFolder(source).files)}
        return [order.get(Path(name).name, -1) for name in names]
    if len(names) == frames.source.frame_count:
        return list(range(len(names)))
    digits = [re.findall(r"\d+", Path(name).stem) for name in names]
    return [int(found[-1]) if found else -1 for found in digits]
