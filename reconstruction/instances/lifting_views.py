"""Projection of the surface into frames with masks: the mask of each vertex in each frame."""

from dataclasses import dataclass

import numpy as np
from numba import njit

from reconstruction.core.mesh_graph import MeshGraph
from reconstruction.core.progress import Progress
from reconstruction.core.rasterize import rasterize_mesh
from reconstruction.core.types import DepthMaps, PosedFrames, Surface
from reconstruction.instances.masks.base import FrameMasks
from registry.geometry import invert_rigid

UNSEEN = -1
_MAX_SIDE_PX = 960  # masks are reduced to this size
_FACING = -0.2  # least cosine between normal and view ray, below 0 since normals of thin objects are noisy
_DEPTH_SLACK = 0.012  # of the depth: a vertex this far behind the rendered surface counts as visible
_MIN_MASK_SHARE = 5e-5  # of the image; smaller masks are ignored
_WITNESSES = 3  # keyframes nearest to a frame whose measured depth confirms vertices
_TURN_M = 0.5  # translation in metres that counts like a rotation by one radian in the distance of two views
_AGREES = 0.03  # of the depth: measured depth within this of a vertex confirms it


@dataclass(frozen=True)
class MaskViews:
    """The mask of each vertex in each frame. Masks are numbered from 1 through all frames; 0 stands for no mask."""

    seen: np.ndarray  # int32 (n, v) mask number, 0 = in no mask, -1 = not visible
    mask_frame: np.ndarray  # int32 (m + 1,) row of the frame of each mask; entry 0 stands for no mask
    mask_id: np.ndarray  # int32 (m + 1,) id in that frame's id image

    @property
    def mask_count(self) -> int:
        """Return the number of masks m."""
        return len(self.mask_frame) - 1


def view_masks(
    graph: MeshGraph,
    surface: Surface,
    posed: PosedFrames,
    depth: DepthMaps,
    masks: FrameMasks,
    progress: Progress,
) -> MaskViews:
    """Project the vertices of `graph`, in world space, into every frame that has masks.

    A vertex is visible if it is not occluded, does not face away, and one of the nearest keyframes has measured its
    depth. The last condition excludes surface that is only visible through a hole in the mesh.
    """
    masks = _at_working_size(masks)
    camera = masks.camera
    count = len(masks.frame_indices)
    seen = np.full((count, len(graph.points)), UNSEEN, np.int32)
    frame_of, id_of = [UNSEEN], [0]
    points, normals = np.ascontiguousarray(graph.points), np.ascontiguousarray(graph.normals)
    key_poses = np.asarray(posed.world_from_camera, np.float64)
    progress.start(count, "masks onto the surface")
    for row in range(count):
        ids = masks.ids[row]
        numbers, first = _numbered(ids, len(frame_of))
        frame_of += [row] * len(numbers)
        id_of += numbers.tolist()
        pose = np.asarray(masks.world_from_camera[row], np.float64)
        drawn = rasterize_mesh(points, surface.faces, camera, pose).depth
        near = nearest_views(pose, key_poses, _WITNESSES)[0]
        confirmed = np.zeros(len(points), bool)
        for key in near:
            _confirm(
                points, invert_rigid(key_poses[key]), depth.camera.fx, depth.camera.fy, depth.camera.cx,
                depth.camera.cy, np.ascontiguousarray(depth.depth[key], np.float32), _AGREES, confirmed,
            )  # fmt: skip
        _look_up(
            points, normals, invert_rigid(pose), pose[:3, 3], camera.fx, camera.fy, camera.cx, camera.cy,
            drawn, first[ids], confirmed, _DEPTH_SLACK, _FACING, seen[row],
        )  # fmt: skip
        progress.advance()
    return MaskViews(seen, np.array(frame_of, np.int32), np.array(id_of, np.int32))


def nearest_views(pose: np.ndarray, others: np.ndarray, most: int) -> tuple[np.ndarray, np.ndarray]:
    """Return rows of the poses (n, 4, 4) nearest to `pose`, at most `most`, and their distances.

    The distance is the translation in metres plus 0.5 m per radian between the viewing directions.
    """
    step = np.linalg.norm(others[:, :3, 3] - pose[:3, 3], axis=1)
    turn = np.arccos(np.clip(others[:, :3, 2] @ pose[:3, 2], -1.0, 1.0))
    away = step + _TURN_M * turn
    near = np.argsort(away, kind="stable")[:most]
    return near, away[near]


def _at_working_size(masks: FrameMasks) -> FrameMasks:
    camera = masks.camera
    scale = min(1.0, _MAX_SIDE_PX / max(camera.width, camera.height))
    return masks.resized(max(1, round(camera.width * scale)), max(1, round(camera.height * scale)))


def _numbered(ids: np.ndarray, start: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the ids of one frame that are large enough, and a table int32 from id to mask number, 0 = none."""
    counts = np.bincount(ids.ravel())
    counts[0] = 0
    numbers = np.flatnonzero(counts >= max(1, _MIN_MASK_SHARE * ids.size))
    table = np.zeros(len(counts), np.int32)
    table[numbers] = start + np.arange(len(numbers))
    return numbers, table


@njit(cache=True, inline="always")
def project(point, camera_from_world, fx, fy, cx, cy):  # pragma: no cover - compiled
    """Return the pixel (u, v) and z-depth of a point; depth 0 where it is nearer than 5 cm or behind the camera."""
    m = camera_from_world
    x, y, z = point
    depth = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3]
    if depth < 0.05:
        return 0.0, 0.0, 0.0
    u = fx * (m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3]) / depth + cx
    v = fy * (m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3]) / depth + cy
    return u, v, depth


@njit(cache=True)
def _confirm(
    points, camera_from_world, fx, fy, cx, cy, measured, agrees, confirmed
):  # pragma: no cover - compiled
    """Set `confirmed` for vertices whose depth a keyframe measured."""
    height, width = measured.shape
    for i in range(points.shape[0]):
        if confirmed[i]:
            continue
        u, v, depth = project(points[i], camera_from_world, fx, fy, cx, cy)
        if depth > 0.0 and 0.0 <= u < width and 0.0 <= v < height:
            found = measured[int(v), int(u)]
            confirmed[i] = found > 0.0 and abs(found - depth) < agrees * depth


@njit(cache=True)
def _look_up(
    points, normals, camera_from_world, eye, fx, fy, cx, cy, drawn, mask, confirmed, slack, facing, out
):  # pragma: no cover - compiled
    """Write the mask of each visible vertex into `out`."""
    height, width = drawn.shape
    for i in range(points.shape[0]):
        if not confirmed[i]:
            continue
        u, v, depth = project(points[i], camera_from_world, fx, fy, cx, cy)
        if not (depth > 0.0 and 0.0 <= u < width and 0.0 <= v < height):
            continue
        column, row = int(u), int(v)
        if drawn[row, column] <= 0.0 or depth > drawn[row, column] * (1.0 + slack):
            continue
        dx, dy, dz = eye[0] - points[i, 0], eye[1] - points[i, 1], eye[2] - points[i, 2]
        distance = np.sqrt(dx * dx + dy * dy + dz * dz)
        if dx * normals[i, 0] + dy * normals[i, 1] + dz * normals[i, 2] < facing * distance:
            continue
        out[i] = mask[row, column]
