"""Compute which points of a surface are visible to a camera, from rendered triangle ids and exact ray-plane tests."""

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numba import njit, prange

from reconstruction.core.rasterize import rasterize_mesh
from reconstruction.core.types import Camera
from registry.geometry import invert_rigid

MAX_DISTANCE_M = 5.0  # CONTRACT section 4: farther points do not count
MAX_CAMERAS = 200
_SIDE_PX = 960  # longer side of the rendered images
_TOLERANCE_M = 0.001  # of a point behind the visible triangle


@njit(cache=True, parallel=True)
def _mark_seen(
    points, m, eye, fx, fy, cx, cy, face, normals, offsets, far, tolerance, seen
):  # pragma: no cover
    """Mark points within `far` of the camera that are not behind the triangle visible at their pixel.

    The ray to the point is intersected with the triangle's plane, so slanted surfaces need no tolerance for pixel size.
    """
    height, width = face.shape
    for i in prange(points.shape[0]):
        if seen[i]:
            continue
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        c = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3]
        if c <= 1e-3:
            continue
        u = fx * (m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3]) / c + cx
        v = fy * (m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3]) / c + cy
        if u < 0 or v < 0 or u >= width or v >= height:
            continue
        dx, dy, dz = x - eye[0], y - eye[1], z - eye[2]
        distance = np.sqrt(dx * dx + dy * dy + dz * dz)
        if distance > far:
            continue
        f = face[int(v), int(u)]
        if f < 0:
            continue
        toward = normals[f, 0] * dx + normals[f, 1] * dy + normals[f, 2] * dz
        gap = normals[f, 0] * x + normals[f, 1] * y + normals[f, 2] * z - offsets[f]
        # eye + t (point - eye) meets the plane at t = 1 - gap / toward; behind it means t < 1.
        if abs(gap) <= tolerance or abs(toward) < 1e-12 or gap / toward * distance <= tolerance:
            seen[i] = True


def seen_points(
    points: np.ndarray,
    vertices: np.ndarray,
    faces: np.ndarray,
    camera: Camera,
    world_from_camera: Sequence[np.ndarray],
    max_distance_m: float = MAX_DISTANCE_M,
    side_px: int = _SIDE_PX,
) -> np.ndarray:
    """Return bool (n,): which points on a mesh are visible to at least one camera.

    Args:
        points: (n, 3) on the mesh, world space, metres.
        vertices: (v, 3) of the occluding mesh.
        faces: (f, 3).
        camera: intrinsics of all poses.
        world_from_camera: poses (4, 4), OpenCV.
        max_distance_m: from the camera center.
        side_px: longer side of the rendered images.
    """
    scale = side_px / max(camera.width, camera.height)
    small = camera.resized(round(camera.width * scale), round(camera.height * scale))
    corners = np.asarray(vertices, np.float64)[np.asarray(faces)]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    offsets = np.einsum("fc,fc->f", normals, corners[:, 0])
    seen = np.zeros(len(points), np.bool_)
    points = np.ascontiguousarray(points, np.float64)
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        # Rasterization releases the GIL and runs in threads; the marking kernel is parallel itself and runs here.
        drawn = pool.map(lambda pose: rasterize_mesh(vertices, faces, small, pose).face, world_from_camera)
        for pose, face in zip(world_from_camera, drawn):
            _mark_seen(
                points, invert_rigid(pose), np.ascontiguousarray(pose[:3, 3]), small.fx, small.fy, small.cx, small.cy,
                face, normals, offsets, max_distance_m, _TOLERANCE_M, seen,
            )  # fmt: skip
    return seen


def spread_poses(world_from_camera: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Return at most 200 evenly spaced poses, since neighboring video frames see the same."""
    rows = np.unique(np.linspace(0, len(world_from_camera) - 1, MAX_CAMERAS).round().astype(int))
    return [world_from_camera[row] for row in rows]
