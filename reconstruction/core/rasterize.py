"""Rasterize a triangle mesh with a z-buffer on the CPU: depth, triangle and barycentric coordinates per pixel.

Used for visibility (texture baking, instance maps, ground truth of generated rooms) and to draw without a graphics
driver.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit

from reconstruction.core.types import Camera
from registry.geometry import invert_rigid

_NEAR_M = 1e-3  # distance of the near plane


@dataclass(frozen=True)
class Raster:
    """The visible triangle of each pixel."""

    depth: np.ndarray  # float32 (h, w) z-depth in units of the mesh, 0 = nothing
    face: np.ndarray  # int32 (h, w) row of the triangle in `faces`, -1 = nothing
    barycentric: np.ndarray  # float32 (h, w, 3) perspective-correct weights of the triangle's vertices

    def interpolate(self, faces: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Interpolate per-vertex values (v, c) over faces (f, 3) to float32 (h, w, c); zero where nothing is seen."""
        out = np.zeros((*self.face.shape, values.shape[1]), np.float32)
        hit = self.face >= 0
        corners = values[faces[self.face[hit]]].astype(np.float32)
        out[hit] = np.einsum("nk,nkc->nc", self.barycentric[hit], corners)
        return out


@njit(cache=True, nogil=True)
def _clip_near(triangle, near, out):  # pragma: no cover - compiled
    """Clip a camera-space triangle (3, 6: xyz, barycentric) at z = near into `out` (4, 6); return the corner count."""
    count = 0
    for i in range(3):
        a, b = triangle[i], triangle[(i + 1) % 3]
        if a[2] >= near:
            out[count] = a
            count += 1
        if (a[2] >= near) != (b[2] >= near):
            t = (near - a[2]) / (b[2] - a[2])
            out[count] = a + t * (b - a)
            count += 1
    return count


@njit(cache=True, nogil=True)
def _draw(points, faces, fx, fy, cx, cy, near, depth, face_map, bary):  # pragma: no cover - compiled
    """Draw camera-space triangles into depth, face_map and bary; triangles clipped to four corners become a fan."""
    height, width = depth.shape
    triangle = np.empty((3, 6))
    poly = np.empty((4, 6))
    sx, sy, iz = np.empty(4), np.empty(4), np.empty(4)
    for f in range(faces.shape[0]):
        behind = 0
        for k in range(3):
            p = points[faces[f, k]]
            triangle[k, 0], triangle[k, 1], triangle[k, 2] = p[0], p[1], p[2]
            triangle[k, 3], triangle[k, 4], triangle[k, 5] = 0.0, 0.0, 0.0
            triangle[k, 3 + k] = 1.0
            if p[2] < near:
                behind += 1
        if behind == 3:
            continue
        corners = 3
        if behind == 0:
            poly[:3] = triangle
        else:
            corners = _clip_near(triangle, near, poly)
        for k in range(corners):
            iz[k] = 1.0 / poly[k, 2]
            sx[k] = fx * poly[k, 0] * iz[k] + cx
            sy[k] = fy * poly[k, 1] * iz[k] + cy
        for fan in range(1, corners - 1):
            a, b, c = 0, fan, fan + 1
            area = (sx[b] - sx[a]) * (sy[c] - sy[a]) - (sx[c] - sx[a]) * (sy[b] - sy[a])
            if abs(area) < 1e-12:
                continue
            x0 = max(0, int(np.ceil(min(sx[a], sx[b], sx[c]) - 0.5)))
            x1 = min(width - 1, int(np.floor(max(sx[a], sx[b], sx[c]) - 0.5)))
            y0 = max(0, int(np.ceil(min(sy[a], sy[b], sy[c]) - 0.5)))
            y1 = min(height - 1, int(np.floor(max(sy[a], sy[b], sy[c]) - 0.5)))
            inv = 1.0 / area
            for y in range(y0, y1 + 1):
                py = y + 0.5
                for x in range(x0, x1 + 1):
                    px = x + 0.5
                    wa = ((sx[b] - px) * (sy[c] - py) - (sx[c] - px) * (sy[b] - py)) * inv
                    wb = ((sx[c] - px) * (sy[a] - py) - (sx[a] - px) * (sy[c] - py)) * inv
                    wc = 1.0 - wa - wb
                    if wa < -1e-9 or wb < -1e-9 or wc < -1e-9:
                        continue
                    z_inv = wa * iz[a] + wb * iz[b] + wc * iz[c]
                    z = 1.0 / z_inv
                    if depth[y, x] > 0.0 and z >= depth[y, x]:
                        continue
                    depth[y, x] = z
                    face_map[y, x] = f
                    for k in range(3):
                        bary[y, x, k] = z * (
                            wa * iz[a] * poly[a, 3 + k] + wb * iz[b] * poly[b, 3 + k] + wc * iz[c] * poly[c, 3 + k]
                        )  # fmt: skip


def rasterize_mesh(
    vertices: np.ndarray, faces: np.ndarray, camera: Camera, world_from_camera: np.ndarray
) -> Raster:
    """Rasterize a mesh, vertices (v, 3) in world space and faces (f, 3); both sides of triangles are visible.

    The near plane is at 1 mm if the mesh is in metres. `world_from_camera` (4, 4) is rigid.
    """
    camera_from_world = invert_rigid(world_from_camera)
    points = np.asarray(vertices, np.float64) @ camera_from_world[:3, :3].T + camera_from_world[:3, 3]
    shape = (camera.height, camera.width)
    depth = np.zeros(shape, np.float32)
    face = np.full(shape, -1, np.int32)
    barycentric = np.zeros((*shape, 3), np.float32)
    _draw(
        np.ascontiguousarray(points), np.ascontiguousarray(faces, np.int32),
        camera.fx, camera.fy, camera.cx, camera.cy, _NEAR_M, depth, face, barycentric,
    )  # fmt: skip
    return Raster(depth, face, barycentric)
