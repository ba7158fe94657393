"""Colors of the surface as the keyframes show them: finer than the mesh, whose colors blur over a centimetre."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numba import njit

from reconstruction.instances.lifting_views import project
from reconstruction.surface.mesh_graph import MeshGraph
from reconstruction.types import DepthMaps, PosedFrames, Surface
from registry.geometry import invert_rigid

# Where a triangle is looked at: its middle, its corners, its edges.
_BARYCENTRIC = np.array(
    [[1, 1, 1], [3, 1, 1], [1, 3, 1], [1, 1, 3], [5, 4, 1], [1, 5, 4], [4, 1, 5]], np.float64
)
_BARYCENTRIC /= _BARYCENTRIC.sum(axis=1, keepdims=True)
_AGREES = 0.015  # of depth: measured depth this near to a sample confirms that it is what is seen there
_FACING = 0.2  # least cosine between normal and view ray


@dataclass(frozen=True)
class SurfaceSamples:
    """Points on the triangles of a part of the surface, a few for each, and how the keyframes show them."""

    points: np.ndarray  # float64 (n, 3) world metres
    normals: np.ndarray  # float64 (n, 3) smoothed, not quite unit
    areas: np.ndarray  # float64 (n,) m² that each stands for
    vertex: np.ndarray  # int64 (n,) nearest corner
    lab: np.ndarray  # float32 (n, 3) mean CIELAB over the frames that see it; nan where none does

    def of(self, chosen: np.ndarray) -> "SurfaceSamples":
        """Return those that a mask or rows choose."""
        return SurfaceSamples(
            self.points[chosen],
            self.normals[chosen],
            self.areas[chosen],
            self.vertex[chosen],
            self.lab[chosen],
        )


def surface_samples(graph: MeshGraph, surface: Surface, chosen: np.ndarray) -> SurfaceSamples:
    """Return samples of the triangles whose corners are all among vertices `chosen`, without colors as yet."""
    inside = np.zeros(len(graph.points), bool)
    inside[chosen] = True
    faces = np.asarray(surface.faces, np.int64)
    faces = faces[inside[faces].all(axis=1)]
    corners = graph.points[faces]
    doubled = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    points = np.einsum("bk,fkd->fbd", _BARYCENTRIC, corners).reshape(-1, 3)
    normals = np.einsum("bk,fkd->fbd", _BARYCENTRIC, graph.normals[faces]).reshape(-1, 3)
    count = len(_BARYCENTRIC)
    vertex = faces[:, _BARYCENTRIC.argmax(axis=1)].reshape(-1)
    areas = np.repeat(doubled / (2.0 * count), count)
    return SurfaceSamples(points, normals, areas, vertex, np.full((len(points), 3), np.nan, np.float32))


def with_colors(samples: SurfaceSamples, posed: PosedFrames, depth: DepthMaps) -> SurfaceSamples:
    """Look at samples in all keyframes that see them.

    Args:
        samples: of the surface in world space.
        posed: keyframes with cameras in world space.
        depth: their depth in metres, which tells what is seen from what is hidden.
    """
    sums, weights = np.zeros((len(samples.points), 3)), np.zeros(len(samples.points))
    camera = posed.camera
    for row in range(len(posed.images) if len(samples.points) else 0):
        pose = np.asarray(posed.world_from_camera[row], np.float64)
        _add_frame(
            samples.points, samples.normals, invert_rigid(pose), pose[:3, 3],
            camera.fx, camera.fy, camera.cx, camera.cy,
            np.ascontiguousarray(depth.depth[row], np.float32), depth.camera.width / camera.width,
            cv2.cvtColor(np.ascontiguousarray(posed.images[row]), cv2.COLOR_RGB2LAB), sums, weights,
        )  # fmt: skip
    lab = np.full((len(weights), 3), np.nan, np.float32)
    seen = weights > 0
    lab[seen] = sums[seen] / weights[seen, None] * [100 / 255, 1, 1] - [0, 128, 128]  # of 8 bits
    return replace(samples, lab=lab)


@njit(cache=True)
def _add_frame(
    points, normals, camera_from_world, eye, fx, fy, cx, cy, measured, depth_scale, lab, sums, weights
):  # pragma: no cover - compiled
    """Add a frame's colors, weighted by how near and how square it sees each sample."""
    height, width = lab.shape[0], lab.shape[1]
    for i in range(points.shape[0]):
        u, v, depth = project(points[i], camera_from_world, fx, fy, cx, cy)
        if not (1.0 <= u < width - 2 and 1.0 <= v < height - 2):
            continue
        row = min(int(v * depth_scale), measured.shape[0] - 1)
        found = measured[row, min(int(u * depth_scale), measured.shape[1] - 1)]
        if found <= 0.0 or abs(found - depth) > _AGREES * depth:
            continue
        dx, dy, dz = eye[0] - points[i, 0], eye[1] - points[i, 1], eye[2] - points[i, 2]
        distance = np.sqrt(dx * dx + dy * dy + dz * dz)
        cosine = (dx * normals[i, 0] + dy * normals[i, 1] + dz * normals[i, 2]) / distance
        if cosine < _FACING:
            continue
        weight = cosine / (depth * depth)
        left, top = int(u - 0.5), int(v - 0.5)
        a, b = u - 0.5 - left, v - 0.5 - top
        for k in range(3):
            upper = lab[top, left, k] * (1.0 - a) + lab[top, left + 1, k] * a
            lower = lab[top + 1, left, k] * (1.0 - a) + lab[top + 1, left + 1, k] * a
            sums[i, k] += weight * (upper * (1.0 - b) + lower * b)
        weights[i] += weight
