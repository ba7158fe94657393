"""Render the object ids of a scene at the cameras of labelled frames, in the distorted pixels of the video."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from reconstruction.core.rasterize import rasterize_mesh
from reconstruction.core.types import Camera
from reconstruction.measure.outline_labels import LabelledFrame, OutlineLabels
from reconstruction.measure.scene import PlacedMesh, bundle_camera, bundle_poses, joined
from registry import SceneBundle
from registry.errors import UsageError

if TYPE_CHECKING:
    from reconstruction.poses.lens import Lens

_ASPECT_TOLERANCE = 0.02  # relative


@dataclass(frozen=True)
class OutlineView:
    """One labelled frame with its outlines and the rendered object ids."""

    frame: LabelledFrame
    shown: np.ndarray  # int32 (h, w) object id per pixel of the video frame, 0 = base or background


def draw_views(
    bundle: SceneBundle, meshes: Sequence[PlacedMesh], labels: OutlineLabels, lens: "Lens | None"
) -> tuple[tuple[OutlineView, ...], tuple[int, ...]]:
    """Render the object ids at each labelled frame with a camera; also return the labelled frames without one.

    Arguments as of `score_outlines`.

    Raises:
        UsageError: a labelled frame does not exist or has another aspect ratio than the video, or none has a camera.
    """
    camera, poses = bundle_camera(bundle), bundle_poses(bundle)
    count, where = bundle.scene["source"]["frame_count"], f"labels {labels.path}"
    for frame in labels.frames:
        if frame.index >= count:
            raise UsageError(
                f"{where}: frame {frame.index} does not exist, {bundle.scene['source']['file']} has {count} frames "
                f"(0 to {count - 1}); are these labels of another video?"
            )
        ratio = frame.width / frame.height * camera.height / camera.width
        if abs(ratio - 1) > _ASPECT_TOLERANCE:
            raise UsageError(
                f"{where}: frame {frame.index} is {frame.width}x{frame.height}, but the video is "
                f"{camera.width}x{camera.height}; label whole upright frames, of any resolution"
            )
    with_camera = [frame for frame in labels.frames if frame.index in poses]
    if not with_camera:
        raise UsageError(
            f"{where}: the scene has no camera of the labelled frames ({_listed([f.index for f in labels.frames])}); "
            f"label some of {_listed(sorted(poses))}"
        )
    vertices, faces = joined(list(meshes))
    ids = np.repeat([0 if m.base else m.id for m in meshes], [len(m.faces) for m in meshes]).astype(np.int32)
    views = []
    for frame in with_camera:
        face = _faces_seen(
            vertices,
            faces,
            camera,
            poses[frame.index],
            (frame.width, frame.height),
            lens and lens.at(frame.index),
        )
        views.append(OutlineView(frame, np.where(face >= 0, ids[face], 0) if len(ids) else face * 0))
    return tuple(views), tuple(f.index for f in labels.frames if f.index not in poses)


def _listed(numbers: Sequence[int], most: int = 12) -> str:
    """Format at most `most` of the numbers, evenly chosen."""
    shown = [numbers[i] for i in np.linspace(0, len(numbers) - 1, min(most, len(numbers))).astype(int)]
    return ", ".join(map(str, shown)) + (", …" if len(shown) < len(numbers) else "")


def _faces_seen(
    vertices: np.ndarray,
    faces: np.ndarray,
    camera: Camera,
    pose: np.ndarray,
    size: tuple[int, int],
    lens: "Lens | None",
) -> np.ndarray:
    """Return the triangle int32 (h, w) at the center of each pixel of the distorted video frame, -1 = none.

    Args:
        vertices: (v, 3) of the scene, world space.
        faces: (f, 3).
        camera: of the undistorted frames.
        pose: world_from_camera (4, 4).
        size: (width, height) of the output.
        lens: distortion; None: none.
    """
    width, height = size
    camera = camera.resized(width, height)
    if lens is None or lens.distorted is None:
        return rasterize_mesh(vertices, faces, camera, pose).face
    grid = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=-1).reshape(-1, 2)
    scale = np.array([lens.camera.width / width, lens.camera.height / height])
    source = lens.straightened(grid * scale) / scale
    # The video frame can exceed the undistorted one, which is rendered with a margin as wide as needed.
    over = np.maximum(-source, source - np.array(size)).max(axis=0)
    margin_x, margin_y = (int(np.ceil(np.clip(side, 0, max(size)))) + 1 for side in over)
    center = camera.cx + margin_x, camera.cy + margin_y
    wide = Camera(width + 2 * margin_x, height + 2 * margin_y, camera.fx, camera.fy, *center)
    drawn = rasterize_mesh(vertices, faces, wide, pose).face
    column, row = np.floor(source + np.array([margin_x, margin_y])).astype(np.int64).T
    inside = (column >= 0) & (row >= 0) & (column < wide.width) & (row < wide.height)
    out = np.full(width * height, -1, np.int32)
    out[inside] = drawn[row[inside], column[inside]]
    return out.reshape(height, width)
