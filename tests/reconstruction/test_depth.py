"""The depth stage on a rendered corner: a textured floor, a box on it, and a wall with a blank patch."""

from dataclasses import replace

import numpy as np
import pytest

from reconstruction.core.rasterize import rasterize_mesh
from reconstruction.core.types import Camera, PosedFrames, VideoSource
from reconstruction.depth import DepthConfig, estimate_depth
from reconstruction.depth.views import depth_ranges, frame_parts, plan_views
from registry.errors import InputError

pytestmark = pytest.mark.stage

CAMERA = Camera(240, 180, 210.0, 210.0, 120.0, 90.0)
CONFIG = DepthConfig(depth_side_px=240, sweep_side_px=160, planes=64, min_speckle_px=20)
BLANK = (np.array([-0.5, 0.35]), np.array([0.1, 0.7]))  # x and z of the wall's blank patch


def quad(a, b, c, d):
    return np.array([a, b, c, d], float), np.array([[0, 1, 2], [0, 2, 3]])


def corner_mesh() -> tuple[np.ndarray, np.ndarray]:
    parts = [
        quad((-2, -2, 0), (2, -2, 0), (2, 1, 0), (-2, 1, 0)),
        quad((-2, 1, 0), (2, 1, 0), (2, 1, 2), (-2, 1, 2)),
        quad((-0.2, 0, 0.3), (0.2, 0, 0.3), (0.2, 0.3, 0.3), (-0.2, 0.3, 0.3)),
        quad((-0.2, 0, 0), (0.2, 0, 0), (0.2, 0, 0.3), (-0.2, 0, 0.3)),
        quad((0.2, 0, 0), (0.2, 0.3, 0), (0.2, 0.3, 0.3), (0.2, 0, 0.3)),
        quad((-0.2, 0, 0), (-0.2, 0.3, 0), (-0.2, 0.3, 0.3), (-0.2, 0, 0.3)),
    ]
    vertices, faces, count = [], [], 0
    for v, f in parts:
        vertices.append(v)
        faces.append(f + count)
        count += len(v)
    return np.concatenate(vertices), np.concatenate(faces)


def texture(points: np.ndarray) -> np.ndarray:
    """Return a smooth random gray pattern in space (n,), blank in the wall's patch."""
    rng = np.random.default_rng(3)
    value = np.full(len(points), 128.0)
    for _ in range(40):
        direction = rng.normal(size=3)
        direction *= rng.uniform(15, 70) / np.linalg.norm(direction)
        value += 12 * np.sin(points @ direction + rng.uniform(0, 6.28))
    (x0, x1), (z0, z1) = BLANK
    patch = (points[:, 1] > 0.99) & (points[:, 0] > x0) & (points[:, 0] < x1)
    value[patch & (points[:, 2] > z0) & (points[:, 2] < z1)] = 128.0
    return value


def render(pose: np.ndarray, gain: float, rng) -> tuple[np.ndarray, np.ndarray]:
    mesh_vertices, mesh_faces = corner_mesh()
    raster = rasterize_mesh(mesh_vertices, mesh_faces, CAMERA, pose)
    points = raster.interpolate(mesh_faces, mesh_vertices).reshape(-1, 3).astype(np.float64)
    gray = texture(points).reshape(raster.depth.shape) * gain + rng.normal(0, 1.0, raster.depth.shape)
    gray[raster.depth == 0] = 0
    return np.repeat(np.clip(gray, 0, 255).astype(np.uint8)[..., None], 3, 2), raster.depth


def look_at(eye, target) -> np.ndarray:
    forward = np.subtract(target, eye) / np.linalg.norm(np.subtract(target, eye))
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    out = np.eye(4)
    out[:3, :3] = np.stack([right, np.cross(forward, right), forward], 1)
    out[:3, 3] = eye
    return out


def make_posed(scale: float = 1.0) -> tuple[PosedFrames, np.ndarray]:
    """Return nine views of the corner, with points, and their true depth; `scale` is that of the poses' space."""
    rng = np.random.default_rng(0)
    images, depth, poses, points, seen = [], [], [], [], []
    count = 0
    for i, x in enumerate(np.linspace(-0.6, 0.6, 9)):
        pose = look_at((x, -1.6, 0.9 + 0.1 * np.sin(3 * x)), (0.1 * x, 0.3, 0.3))
        image, z = render(pose, 1.0 + 0.03 * i, rng)
        y, xx = rng.integers(0, CAMERA.height, 120), rng.integers(0, CAMERA.width, 120)
        good = z[y, xx] > 0
        zz = z[y, xx][good]
        local = np.stack(
            [(xx[good] + 0.5 - CAMERA.cx) / CAMERA.fx * zz, (y[good] + 0.5 - CAMERA.cy) / CAMERA.fy * zz, zz],
            1,
        )
        points.append(local @ pose[:3, :3].T + pose[:3, 3])
        seen.append(np.stack([np.full(good.sum(), i), np.arange(count, count + good.sum())], 1))
        count += int(good.sum())
        pose[:3, 3] *= scale
        images.append(image)
        depth.append(z * scale)
        poses.append(pose)
    n = len(images)
    frames = np.stack(images)
    source = VideoSource("corner.mp4", "0" * 64, CAMERA.width, CAMERA.height, 30.0, n, n / 30)
    posed = PosedFrames(
        source, CAMERA, frames, np.arange(n, dtype=np.int32), np.arange(n) / 30, np.stack(poses),
        np.ones(n, np.float32), frames[:0], np.zeros(0, np.int32), np.zeros(0), np.zeros((0, 4, 4)),
        np.concatenate(points) * scale, np.zeros((count, 3), np.uint8), np.ones(count, np.float32),
        np.concatenate(seen).astype(np.int32), n, True, 0.3,
    )  # fmt: skip
    return posed, np.stack(depth)


@pytest.fixture(scope="module")
def corner():
    return make_posed()


@pytest.fixture(scope="module")
def estimate(corner):
    return estimate_depth(corner[0], CONFIG)


def test_measured_depth_is_accurate_and_dense(corner, estimate) -> None:
    truth = corner[1]
    measured = estimate.confidence == 2
    assert measured[truth > 0].mean() > 0.6
    error = np.abs(estimate.depth - truth)[measured] / truth[measured].clip(1e-6)
    assert np.median(error) < 0.004
    assert (error > 0.05).mean() < 0.05


def test_small_box_is_there(corner, estimate) -> None:
    """Pixels on the box's front must carry its depth, not that of the wall behind."""
    posed, truth = corner
    k = len(truth) // 2
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    z = truth[k]
    local = np.stack([(u + 0.5 - CAMERA.cx) / CAMERA.fx * z, (v + 0.5 - CAMERA.cy) / CAMERA.fy * z, z], -1)
    world = local @ posed.world_from_camera[k, :3, :3].T + posed.world_from_camera[k, :3, 3]
    front = (np.abs(world[..., 1]) < 0.005) & (world[..., 2] > 0.05) & (world[..., 2] < 0.25)
    assert front.sum() > 300
    found = estimate.depth[k][front]
    assert (np.abs(found / z[front] - 1) < 0.02).mean() > 0.85


def test_blank_wall_is_completed_with_its_plane(corner, estimate) -> None:
    posed, truth = corner
    (x0, x1), (z0, z1) = BLANK
    filled = right = total = 0
    for k in range(2, 7):
        v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
        z = truth[k]
        local = np.stack(
            [(u + 0.5 - CAMERA.cx) / CAMERA.fx * z, (v + 0.5 - CAMERA.cy) / CAMERA.fy * z, z], -1
        )
        world = local @ posed.world_from_camera[k, :3, :3].T + posed.world_from_camera[k, :3, 3]
        patch = (world[..., 1] > 0.99) & (world[..., 0] > x0 + 0.05) & (world[..., 0] < x1 - 0.05)
        patch &= (world[..., 2] > z0 + 0.05) & (world[..., 2] < z1 - 0.05)
        got = estimate.depth[k][patch]
        total += patch.sum()
        filled += (got > 0).sum()
        right += (np.abs(got / z[patch] - 1) < 0.02).sum()
    assert filled > 0.8 * total
    assert right > 0.9 * filled


def test_confidence_says_where_depth_is(estimate) -> None:
    assert ((estimate.depth > 0) == (estimate.confidence > 0)).all()
    assert estimate.depth.dtype == np.float32
    assert set(np.unique(estimate.confidence)) <= {0, 1, 2}


def test_result_does_not_depend_on_scale(estimate) -> None:
    posed, truth = make_posed(scale=0.02)
    small = estimate_depth(posed, CONFIG)
    measured = small.confidence == 2
    error = np.abs(small.depth - truth)[measured] / truth[measured].clip(1e-9)
    assert np.median(error) < 0.004
    assert abs(measured.mean() - (estimate.confidence == 2).mean()) < 0.02


def test_result_does_not_depend_on_threads(corner, estimate) -> None:
    again = estimate_depth(corner[0], replace(CONFIG, threads=1))
    assert np.array_equal(again.depth, estimate.depth)
    assert np.array_equal(again.confidence, estimate.confidence)


def test_sources_have_baseline_and_overlap(corner) -> None:
    plan = plan_views(corner[0], CONFIG)
    for i, row in enumerate(plan.sources):
        for part in row:
            chosen = part[part >= 0]
            assert len(chosen) >= 2
            assert i not in chosen
            assert len(set(chosen)) == len(chosen)


def seen_twice(posed: PosedFrames, truth: np.ndarray, plan) -> np.ndarray:
    """Return for each frame the share of pixels that two of their part's sources have inside, 2 to 16 degrees off."""
    out, camera = [], posed.camera
    for i, z in enumerate(truth):
        pose, count = posed.world_from_camera[i], np.zeros(z.shape, int)
        y, x = np.mgrid[: z.shape[0], : z.shape[1]]
        local = np.stack(
            [(x + 0.5 - camera.cx) / camera.fx * z, (y + 0.5 - camera.cy) / camera.fy * z, z], -1
        )
        world = local @ pose[:3, :3].T + pose[:3, 3]
        for (top, bottom, left, right), sources in zip(frame_parts(*z.shape), plan.sources[i]):
            part = world[top:bottom, left:right]
            for s in sources[sources >= 0]:
                other = posed.world_from_camera[s]
                u, v, w = np.moveaxis((part - other[:3, 3]) @ other[:3, :3] @ camera.matrix.T, -1, 0)
                a, b = part - pose[:3, 3], part - other[:3, 3]
                length = np.linalg.norm(a, axis=-1) * np.linalg.norm(b, axis=-1)
                cosine = (a * b).sum(-1) / np.maximum(length, 1e-9)
                good = (w > 0) & (u > 0) & (v > 0) & (u < camera.width * w) & (v < camera.height * w)
                good &= (cosine < np.cos(np.radians(2))) & (cosine > np.cos(np.radians(16)))
                count[top:bottom, left:right] += good
        out.append((count >= 2)[z > 0].mean())
    return np.array(out)


def test_margins_of_turning_frames_have_sources_of_their_own() -> None:
    # The camera walks around a corner and turns by 8 degrees a frame: no four frames see all of another one.
    rng = np.random.default_rng(0)
    images, truth, poses, points, seen, count = [], [], [], [], [], 0
    for i, angle in enumerate(np.radians(np.arange(-48, 49, 8))):
        eye = np.array([0.5 * np.sin(angle), -1.3 + 0.2 * np.cos(angle), 0.9])
        pose = look_at(eye, eye + np.array([np.sin(angle), np.cos(angle), -0.35]))
        image, z = render(pose, 1.0, rng)
        y, x = rng.integers(0, CAMERA.height, 120), rng.integers(0, CAMERA.width, 120)
        y, x = y[z[y, x] > 0], x[z[y, x] > 0]
        ray = np.stack(
            [(x + 0.5 - CAMERA.cx) / CAMERA.fx, (y + 0.5 - CAMERA.cy) / CAMERA.fy, np.ones(len(x))], 1
        )
        points.append((ray * z[y, x, None]) @ pose[:3, :3].T + pose[:3, 3])
        seen.append(np.stack([np.full(len(x), i), count + np.arange(len(x))], 1))
        count += len(x)
        images.append(image)
        truth.append(z)
        poses.append(pose)
    template, n = make_posed()[0], len(images)
    posed = replace(
        template, images=np.stack(images), indices=np.arange(n, dtype=np.int32), times_s=np.arange(n) / 30,
        world_from_camera=np.stack(poses), sharpness=np.ones(n, np.float32), points=np.concatenate(points),
        point_colors=np.zeros((count, 3), np.uint8), point_errors_px=np.ones(count, np.float32),
        observations=np.concatenate(seen).astype(np.int32),
    )  # fmt: skip
    middle = seen_twice(posed, np.stack(truth), plan_views(posed, CONFIG))[3:-3]
    assert middle.min() > 0.9


def test_range_covers_the_true_depth(corner) -> None:
    posed, truth = corner
    near, far = depth_ranges(posed)
    for i in range(len(truth)):
        z = truth[i][truth[i] > 0]
        assert near[i] < np.percentile(z, 1)
        assert far[i] > np.percentile(z, 99)


def test_frame_without_points_borrows_its_range(corner) -> None:
    posed, truth = corner
    lonely = replace(posed, observations=posed.observations[posed.observations[:, 0] != 4])
    near, far = depth_ranges(lonely)
    assert near[4] < np.median(truth[4][truth[4] > 0]) < far[4]


def test_no_points_is_an_input_error(corner) -> None:
    none = {"point_colors": np.zeros((0, 3), np.uint8), "point_errors_px": np.zeros(0, np.float32)}
    empty = replace(corner[0], points=np.zeros((0, 3)), observations=np.zeros((0, 2), np.int32), **none)
    with pytest.raises(InputError, match="sparse points"):
        estimate_depth(empty, CONFIG)


def test_blank_frames_are_an_input_error(corner) -> None:
    blank = replace(corner[0], images=np.full_like(corner[0].images, 90))
    with pytest.raises(InputError, match="measured"):
        estimate_depth(blank, CONFIG)
