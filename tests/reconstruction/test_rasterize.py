"""The triangle rasterizer against analytic ray casting."""

import numpy as np
import trimesh

from reconstruction.core.rasterize import rasterize_mesh
from reconstruction.core.types import Camera

CAMERA = Camera(64, 48, 50.0, 52.0, 31.0, 25.0)


def _rays() -> np.ndarray:
    u, v = np.meshgrid(np.arange(CAMERA.width) + 0.5, np.arange(CAMERA.height) + 0.5)
    return np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones_like(u)], -1)


def test_plane_depth_is_exact_and_perspective_correct():
    # The plane z = 2 + 0.3 x, larger than the view.
    xy = np.array([[-9.0, -9], [9, -9], [9, 9], [-9, 9]])
    vertices = np.column_stack([xy, 2 + 0.1 * xy[:, 0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    raster = rasterize_mesh(vertices, faces, CAMERA, np.eye(4))
    expected = 2 / (1 - 0.1 * _rays()[..., 0])
    assert (raster.face >= 0).all()
    np.testing.assert_allclose(raster.depth, expected, rtol=1e-6)
    points = raster.interpolate(faces, vertices)
    np.testing.assert_allclose(points, _rays() * expected[..., None], rtol=1e-4, atol=1e-5)


def test_triangles_crossing_the_camera_plane_are_clipped_not_lost():
    # A floor that passes under and behind the camera.
    vertices = np.array([[-50.0, 1, -50], [50, 1, -50], [50, 1, 50], [-50, 1, 50]])
    raster = rasterize_mesh(vertices, np.array([[0, 1, 2], [0, 2, 3]]), CAMERA, np.eye(4))
    rays = _rays()
    below = rays[..., 1] > 1 / 50 + 1e-3
    np.testing.assert_allclose(raster.depth[below], 1 / rays[..., 1][below], rtol=1e-5)
    assert (raster.depth[rays[..., 1] < 0] == 0).all()


def test_sphere_from_a_moved_camera_has_the_nearest_surface():
    sphere = trimesh.creation.icosphere(subdivisions=5, radius=0.5)
    world_from_camera = np.eye(4)
    world_from_camera[:3, 3] = [0.1, -0.05, -2.0]
    raster = rasterize_mesh(sphere.vertices, sphere.faces, CAMERA, world_from_camera)
    rays = _rays()
    origin = world_from_camera[:3, 3]
    a, b, c = (rays**2).sum(-1), 2 * (rays @ origin), origin @ origin - 0.25
    hit = b**2 - 4 * a * c > 0.05
    depth = (-b - np.sqrt(np.maximum(b**2 - 4 * a * c, 0))) / (2 * a)
    assert hit.sum() > 100
    np.testing.assert_allclose(raster.depth[hit], depth[hit], atol=2e-3)
