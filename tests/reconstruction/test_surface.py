"""The surface stage on analytic depth: a sphere on a floor, seen by a ring of cameras, and a long corridor."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from notes import Notes

from reconstruction.core.types import Camera, DepthMaps, PosedFrames, VideoSource
from reconstruction.measure.surfaces import sample
from reconstruction.surface import SurfaceConfig, fuse_surface
from registry.errors import InputError

pytestmark = pytest.mark.stage

CENTER, RADIUS = np.array([0.0, 0.0, 0.15]), 0.15
CAMERA = Camera(120, 90, 110.0, 110.0, 60.0, 45.0)
BLUE, RED = np.array([40, 60, 200], np.uint8), np.array([200, 50, 40], np.uint8)


def look_at(eye: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return world_from_camera (OpenCV) of an upright camera at `eye` that looks at `target`."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    out = np.eye(4)
    out[:3, :3] = np.stack([right, np.cross(forward, right), forward], 1)
    out[:3, 3] = eye
    return out


def cast(pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return z-depth (h, w) and whether the sphere is seen there; the floor is z = 0 within 1 m of the origin."""
    u, v = np.meshgrid(np.arange(CAMERA.width) + 0.5, np.arange(CAMERA.height) + 0.5)
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones_like(u)], -1)
    rays = rays @ pose[:3, :3].T
    eye = pose[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        floor = -eye[2] / rays[..., 2]
    point = eye + rays * floor[..., None]
    floor = np.where((floor > 0) & (np.hypot(point[..., 0], point[..., 1]) < 1.0), floor, np.inf)
    a = (rays**2).sum(-1)
    b = rays @ (eye - CENTER)
    c = (eye - CENTER) @ (eye - CENTER) - RADIUS**2
    root = b * b - a * c
    sphere = np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / a, np.inf)
    z = np.minimum(floor, sphere)
    return np.where(np.isfinite(z), z, 0).astype(np.float32), sphere < floor


@pytest.fixture(scope="module")
def scene() -> tuple[PosedFrames, DepthMaps, np.ndarray]:
    poses, depth, images, masks = [], [], [], []
    for angle in np.linspace(0, 2 * np.pi, 16, endpoint=False):
        for height in (0.5, 0.9):
            eye = np.array([1.1 * np.cos(angle), 1.1 * np.sin(angle), height])
            pose = look_at(eye, np.array([0.0, 0.0, 0.1]))
            z, is_sphere = cast(pose)
            poses.append(pose)
            depth.append(z)
            masks.append(is_sphere)
            images.append(np.where(is_sphere[..., None], RED, BLUE))
    n, none = len(poses), np.zeros(0)
    source = VideoSource("ring.mp4", "0" * 64, CAMERA.width, CAMERA.height, 30.0, n, n / 30)
    frames = np.stack(images)
    posed = PosedFrames(
        source, CAMERA, frames, np.arange(n, dtype=np.int32), np.arange(n) / 30, np.stack(poses),
        np.ones(n, np.float32), frames[:0], np.zeros(0, np.int32), none, np.zeros((0, 4, 4)), np.zeros((0, 3)),
        np.zeros((0, 3), np.uint8), np.zeros(0, np.float32), np.zeros((0, 2), np.int32), n, True, 0.1,
    )  # fmt: skip
    maps = np.stack(depth)
    return posed, DepthMaps(CAMERA, maps, (maps > 0).astype(np.uint8) * 2), np.stack(masks)


def distance_to_truth(points: np.ndarray) -> np.ndarray:
    sphere = np.abs(np.linalg.norm(points - CENTER, axis=1) - RADIUS)
    return np.minimum(sphere, np.abs(points[:, 2]))


@pytest.fixture(scope="module")
def surface(scene):
    return fuse_surface(scene[0], scene[1], SurfaceConfig(voxel_size_m=0.012, space_voxel_m=0.03))


def test_mesh_lies_on_the_true_surface(surface) -> None:
    error = distance_to_truth(surface.vertices.astype(np.float64))
    assert np.median(error) < 0.002
    assert np.percentile(error, 95) < 0.012


def test_mesh_covers_what_was_seen(surface) -> None:
    from scipy.spatial import cKDTree

    rng = np.random.default_rng(0)
    direction = rng.normal(size=(2000, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    upper = CENTER + RADIUS * direction[direction[:, 2] > -0.2]
    floor = np.column_stack([rng.uniform(-0.6, 0.6, (1000, 2)), np.zeros(1000)])
    floor = floor[np.hypot(floor[:, 0], floor[:, 1]) > 0.25]
    points = sample(surface.vertices.astype(np.float64), surface.faces, 60_000).points
    distance, _ = cKDTree(points).query(np.concatenate([upper, floor]))
    assert np.percentile(distance, 98) < 0.025


def test_faces_and_normals_point_to_free_space(surface) -> None:
    a, b, c = (surface.vertices[surface.faces[:, i]].astype(np.float64) for i in range(3))
    cross = np.cross(b - a, c - a)
    agree = (cross * surface.normals[surface.faces[:, 0]]).sum(1) > 0
    assert agree[np.linalg.norm(cross, axis=1) > 1e-7].mean() > 0.97
    radius = np.hypot(surface.vertices[:, 0], surface.vertices[:, 1])
    on_floor = (radius > 0.4) & (radius < 0.9)
    assert (surface.normals[on_floor, 2] > 0.95).mean() > 0.98
    assert np.allclose(np.linalg.norm(surface.normals, axis=1), 1, atol=1e-3)


def test_colors_come_from_the_images(surface) -> None:
    top = surface.vertices[:, 2] > 0.2
    floor = np.hypot(surface.vertices[:, 0], surface.vertices[:, 1]) > 0.5
    assert np.abs(np.median(surface.colors[top], axis=0) - RED).max() <= 2
    assert np.abs(np.median(surface.colors[floor], axis=0) - BLUE).max() <= 2


def test_space_is_free_outside_and_unknown_inside(surface) -> None:
    rng = np.random.default_rng(1)
    inside = CENTER + rng.uniform(-0.05, 0.05, (200, 3))
    assert (surface.space.lookup(inside) == 0).all()
    above = np.column_stack([rng.uniform(-0.3, 0.3, (200, 2)), rng.uniform(0.36, 0.42, 200)])
    assert (surface.space.lookup(above) == 1).mean() > 0.99
    below = np.column_stack([rng.uniform(-0.4, 0.4, (200, 2)), np.full(200, -0.04)])
    assert (surface.space.lookup(below) != 1).all()
    assert (surface.space.lookup(np.array([[0.5, 0.0, 0.0]])) == 2).all()


def test_completed_pixels_do_not_move_measured_surface(scene) -> None:
    posed, depth, _ = scene
    wrong, confidence = depth.depth.copy(), depth.confidence.copy()
    wrong[::4] *= 0.98
    confidence[::4] = 1
    config = SurfaceConfig(voxel_size_m=0.012, space_voxel_m=0.03)
    surface = fuse_surface(posed, replace(depth, depth=wrong, confidence=confidence), config)
    assert np.median(distance_to_truth(surface.vertices.astype(np.float64))) < 0.003


def test_one_stray_view_makes_no_surface(scene) -> None:
    posed, depth, _ = scene
    strayed = depth.depth.copy()
    strayed[0, 40:50, 20:30] = 0.5
    config = SurfaceConfig(voxel_size_m=0.012, space_voxel_m=0.03)
    surface = fuse_surface(posed, replace(depth, depth=strayed), config)
    assert distance_to_truth(surface.vertices.astype(np.float64)).max() < 0.06


def test_thinning_bounds_the_mesh_and_keeps_its_shape(scene, surface) -> None:
    limit = len(surface.vertices) // 2
    config = SurfaceConfig(voxel_size_m=0.012, space_voxel_m=0.03, max_vertices=limit)
    thin = fuse_surface(scene[0], scene[1], config)
    assert 0 < len(thin.vertices) <= limit
    assert np.percentile(distance_to_truth(thin.vertices.astype(np.float64)), 95) < 0.015
    assert thin.faces.max() < len(thin.vertices)


def test_fusion_is_deterministic(scene, surface) -> None:
    again = fuse_surface(scene[0], scene[1], SurfaceConfig(voxel_size_m=0.012, space_voxel_m=0.03))
    assert np.array_equal(again.vertices, surface.vertices)
    assert np.array_equal(again.faces, surface.faces)
    assert np.array_equal(again.space.state, surface.space.state)


def test_large_scenes_are_coarsened_with_a_note(scene) -> None:
    config = SurfaceConfig(voxel_size_m=0.01, max_blocks=300, space_voxel_m=0.02, max_space_cells=20_000)
    said = Notes()
    surface = fuse_surface(scene[0], scene[1], config, progress=said)
    assert surface.voxel_size_m > 0.01
    assert surface.space.voxel_size_m > 0.02
    assert sum("since the scene is large" in note for note in said.notes) == 2


def test_no_depth_is_an_input_error(scene) -> None:
    posed, depth, _ = scene
    with pytest.raises(InputError, match="depth samples"):
        fuse_surface(posed, replace(depth, depth=np.zeros_like(depth.depth)), SurfaceConfig())


def test_slabs_leave_no_seam(scene) -> None:
    posed, depth, _ = scene
    config = SurfaceConfig(voxel_size_m=0.008, space_voxel_m=0.03)
    whole = fuse_surface(posed, depth, replace(config, slab_blocks=10**9))
    parts = fuse_surface(posed, depth, replace(config, slab_blocks=60))
    assert np.array_equal(whole.vertices, parts.vertices)
    assert np.array_equal(whole.faces, parts.faces)
    assert np.array_equal(whole.colors, parts.colors)


def test_the_flat_floor_is_thinned_before_the_round_thing(scene, surface) -> None:
    config = SurfaceConfig(voxel_size_m=0.012, space_voxel_m=0.03, max_vertices=len(surface.vertices) // 2)
    thinned = fuse_surface(scene[0], scene[1], config)
    a, b = (thinned.vertices[thinned.faces[:, i]] for i in (0, 1))
    lengths, middle = np.linalg.norm(a - b, axis=1), 0.5 * (a + b)
    ball = middle[:, 2] > 0.1
    floor = (np.hypot(middle[:, 0], middle[:, 1]) > 0.4) & ~ball
    assert np.median(lengths[ball]) < 0.016
    assert np.median(lengths[floor]) > 2 * np.median(lengths[ball])


def corridor(length: float) -> tuple[PosedFrames, DepthMaps]:
    """Return analytic depth of a straight corridor, 2 m wide and 2.4 m high, walked along x."""
    u, v = np.meshgrid(np.arange(CAMERA.width) + 0.5, np.arange(CAMERA.height) + 0.5)
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones_like(u)], -1)
    poses, maps = [], []
    for x in np.arange(0, length, 0.3):
        for sideways in (-0.8, 0.8):
            pose = look_at(np.array([x, 0.0, 1.3]), np.array([x + 1.0, sideways, 1.2]))
            ray = rays @ pose[:3, :3].T
            with np.errstate(divide="ignore"):
                walls = np.minimum(np.where(ray[..., 1] > 0, 1, -1) / ray[..., 1], np.inf)
                level = np.where(ray[..., 2] > 0, 1.1, -1.3) / ray[..., 2]
            z = np.minimum(walls, level)
            poses.append(pose)
            maps.append(np.where(z < 4, z, 0).astype(np.float32))
    n, z = len(poses), np.zeros
    frames = np.full((n, CAMERA.height, CAMERA.width, 3), 128, np.uint8)
    source = VideoSource("walk.mp4", "0" * 64, CAMERA.width, CAMERA.height, 30.0, n, n / 30)
    posed = PosedFrames(
        source, CAMERA, frames, np.arange(n, dtype=np.int32), np.arange(n) / 30, np.stack(poses),
        np.ones(n, np.float32), frames[:0], z(0, np.int32), z(0), z((0, 4, 4)), z((0, 3)),
        z((0, 3), np.uint8), z(0, np.float32), z((0, 2), np.int32), n, True, 0.1,
    )  # fmt: skip
    depth = np.stack(maps)
    return posed, DepthMaps(CAMERA, depth, (depth > 0).astype(np.uint8) * 2)


def test_memory_is_bounded_by_the_slab_not_by_the_scene() -> None:
    config = SurfaceConfig(voxel_size_m=0.012, space_voxel_m=0.1, max_vertices=40_000, slab_blocks=1500)

    def peak_mb(length: float, slab_blocks: int) -> float:
        posed, depth = corridor(length)
        tracemalloc.start()
        try:
            surface = fuse_surface(posed, depth, replace(config, slab_blocks=slab_blocks))
            assert np.ptp(surface.vertices[:, 0]) > 0.95 * length
            return tracemalloc.get_traced_memory()[1] / 2**20
        finally:
            tracemalloc.stop()

    whole, parts = peak_mb(16.0, 10**9), peak_mb(16.0, 1500)
    assert parts < 75
    assert whole > 2 * parts


def test_space_is_told_right_in_a_furnished_room() -> None:
    """Of a generated room with true depth: what is free is known, and nothing within things is called free."""
    from synthetic.capture import make_test_capture

    capture = make_test_capture(16, 240, 180, seed=3)
    space = fuse_surface(capture.posed, capture.depth, SurfaceConfig(voxel_size_m=0.012)).space
    cells = np.stack(np.nonzero(space.state == 1), axis=1)
    centers = space.origin + (cells + 0.5) * space.voxel_size_m
    inside, jitter = 0, np.array([1.0e-3, 1.7e-3, 1.3e-3])
    for entity in capture.entities:
        mesh = entity.mesh()
        near = centers[((centers > mesh.bounds[0]) & (centers < mesh.bounds[1])).all(axis=1)]
        if len(near):  # rays along edges err: both of two shifted points must be inside
            inside += int((mesh.contains(near + jitter) & mesh.contains(near - jitter)).sum())
    assert inside <= 3  # of some 400,000, and those by two millimetres
    # What two frames look through, well before anything, is known to be free.
    free = 0, 0
    rng = np.random.default_rng(0)
    for row in (2, 8, 13):
        y, x = rng.integers(0, 180, 300), rng.integers(0, 240, 300)
        z = capture.depth.depth[row, y, x] * rng.uniform(0.5, 0.85, 300)
        camera = capture.depth.camera
        local = np.stack(
            [(x + 0.5 - camera.cx) / camera.fx * z, (y + 0.5 - camera.cy) / camera.fy * z, z], axis=1
        )
        pose = capture.posed.world_from_camera[row]
        state = space.lookup((local @ pose[:3, :3].T + pose[:3, 3])[z > 0.4])
        free = free[0] + (state == 1).sum(), free[1] + len(state)
    assert free[0] / free[1] > 0.93
