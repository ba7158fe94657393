"""Import poses from COLMAP, nerfstudio, Record3D or Polycam and assign them to frames by image name.

For a folder of images, names are the file names of that folder. For a video, either the import has one image per video
frame (name order is frame order), or the last number in a name is the video frame number, from 0.
"""

import re
from pathlib import Path

from reconstruction.core.types import FrameSet
from reconstruction.frames.decoding import ImageFolder
from reconstruction.phone_exports.exports import find_export, turned_camera
from reconstruction.phone_exports.named_poses import ImportedPoses, NamedPoses
from reconstruction.phone_exports.polycam import read_polycam
from reconstruction.phone_exports.record3d import read_record3d
from reconstruction.poses.importers.colmap import read_colmap
from reconstruction.poses.importers.model import check_consistency, model_from_poses
from reconstruction.poses.importers.nerfstudio import read_transforms
from registry.errors import UsageError

__all__ = [
    "ImportedPoses",
    "check_consistency",
    "find_export",
    "model_from_poses",
    "read_poses",
    "turned_camera",
]

_MIN_COMMON_FRAMES = 8


def read_poses(path: Path, frames: FrameSet) -> ImportedPoses:
    """Read poses and assign them to frames; intrinsics are rescaled to the frames.

    Raises:
        UsageError: the format is unknown, the images have another shape, or too few keyframes have a pose.
    """
    found = _read(path)
    camera, named = found.camera, found.named
    numbers = _frame_numbers([name for name, _ in named], frames)
    height, width = frames.images.shape[1:3]
    if abs(width / height - camera.width / camera.height) > 0.02 * width / height:
        raise UsageError(
            f"poses: {path} is of {camera.width}x{camera.height} images, the frames are {width}x{height}: "
            "the shapes differ, so they are not of the same video"
        )
    camera.rescale(width, height)
    poses = {number: pose for number, (_, pose) in zip(numbers, named)}
    imported = ImportedPoses(camera, poses, found.metric, found.roll_unknown, found.notes)
    common = sum(int(index) in imported.world_from_camera for index in frames.indices)
    if common < _MIN_COMMON_FRAMES:
        raise UsageError(
            f"poses: {path} has poses for {common} of the {len(frames.indices)} keyframes, at least "
            f"{_MIN_COMMON_FRAMES} are needed; is it of this video? Its names must hold video frame numbers "
            f"(first name: {named[0][0] if named else 'none'})"
        )
    return imported


def _read(path: Path) -> NamedPoses:
    """Detect the format and read it."""
    export = find_export(path)
    if export is not None:
        return read_record3d(export) if export.kind == "record3d" else read_polycam(export)
    if path.is_dir() and (path / "transforms.json").is_file():
        path = path / "transforms.json"
    if path.is_file() and path.suffix == ".json":
        return read_transforms(path)
    if path.is_dir() and any((path / f"images{suffix}").is_file() for suffix in (".bin", ".txt")):
        return read_colmap(path)
    raise UsageError(
        f"poses: {path} holds no poses that can be read: a COLMAP model folder (cameras, images and points3D as "
        ".bin or .txt), a nerfstudio transforms.json, a Record3D recording (.r3d, or unzipped) or Polycam's raw data"
    )


def _frame_numbers(names: list[str], frames: FrameSet) -> list[int]:
    """Return the video frame number of each of the sorted image names; -1 where there is none."""
    source = Path(frames.source.file)
    export = find_export(source)
    if export is not None:
        order = {Path(name).name: number for number, name in enumerate(export.images)}
        return [order.get(Path(name).name, -1) for name in names]
    if source.is_dir():
        # Listed as in stage 1, so that order and left-out files agree.
        order = {path.name: number for number, path in enumerate(ImageFolder(source).files)}
        return [order.get(Path(name).name, -1) for name in names]
    if len(names) == frames.source.frame_count:
        return list(range(len(names)))
    digits = [re.findall(r"\d+", Path(name).stem) for name in names]
    return [int(found[-1]) if found else -1 for found in digits]
