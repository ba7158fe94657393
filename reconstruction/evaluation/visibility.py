"""Which points of a surface some camera sees: a depth map per camera, compared with each point's own depth."""

from collections.abc import Sequence

import numpy as np
from numba import njit, prange

from reconstruction.rasterize import rasterize_mesh
from reconstruction.types import Camera
from registry.geometry import invert_rigid

MAX_DISTANCE_M = 5.0  # CONTRACT section 4: what is farther does not count
_SIDE_PX = 640
_TOLERANCE_M, _TOLERANCE_SHARE = 0.002, 0.001


@njit(cache=True, parallel=True)
def _mark_seen(points, m, fx, fy, cx, cy, depth, far, tolerance, share, seen):  # pragma: no cover - compiled
    """Mark points that lie within `far` of the camera and not behind all of the four pixels around them."""
    height, width = depth.shape
    for i in prange(points.shape[0]):
        if seen[i]:
            continue
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        a = m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3]
        b = m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3]
        c = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3]
        if c <= 1e-3 or a * a + b * b + c * c > far * far:
            continue
        u, v = fx * a / c + cx, fy * b / c + cy
        if u < 0 or v < 0 or u >= width or v >= height:
            continue
        left, top = int(np.floor(u - 0.5)), int(np.floor(v - 0.5))
        # The depth map is sampled at pixel centers; on a slanted surface the point lies between the four around it.
        limit = 0.0
        for row in range(max(top, 0), min(top + 2, height)):
            for column in range(max(left, 0), min(left + 2, width)):
                limit = max(limit, depth[row, column])
        if limit > 0.0 and c <= limit * (1.0 + share) + tolerance:
            seen[i] = True


def seen_points(
    points: np.ndarray,
    vertices: np.ndarray,
    faces: np.ndarray,
    camera: Camera,
    world_from_camera: Sequence[np.ndarray],
    max_distance_m: float = MAX_DISTANCE_M,
) -> np.ndarray:
    """Tell which points on a mesh some camera sees.

    Args:
        points: (n, 3) on the mesh, world space, metres.
        vertices: (v, 3) of everything that can hide them.
        faces: (f, 3).
        camera: of all poses; depth maps are drawn at most 640 pixels wide.
        world_from_camera: poses (4, 4), OpenCV.
        max_distance_m: from the camera's center.

    Returns:
        bool (n,).
    """
    scale = min(1.0, _SIDE_PX / max(camera.width, camera.height))
    small = camera.resized(round(camera.width * scale), round(camera.height * scale))
    seen = np.zeros(len(points), np.bool_)
    points = np.ascontiguousarray(points, np.float64)
    for pose in world_from_camera:
        depth = rasterize_mesh(vertices, faces, small, pose).depth
        _mark_seen(
            points, invert_rigid(pose), small.fx, small.fy, small.cx, small.cy, depth, max_distance_m,
            _TOLERANCE_M, _TOLERANCE_SHARE, seen,
        )  # fmt: skip
    return seen
