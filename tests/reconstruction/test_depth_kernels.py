"""The vectorized kernels of the depth stage against plain NumPy."""

from types import SimpleNamespace

import numpy as np
import pytest

from reconstruction.core.types import Camera
from reconstruction.depth.consistency import check_view, count_witnesses
from reconstruction.depth.measure import sweep_frame
from reconstruction.depth.refine import fit_slopes, refine
from reconstruction.depth.scene import plane_warps
from reconstruction.depth.sweep import sweep_costs
from reconstruction.depth.views import ViewPlan, frame_parts
from reconstruction.depth.windows import make_correlate, offsets, project, source_maps

H, W = 30, 41
K = np.array([[40.0, 0, W / 2], [0, 40.0, H / 2], [0, 0, 1]])
NOISE = 2.0


@pytest.fixture(scope="module")
def images() -> np.ndarray:
    return np.random.default_rng(0).uniform(-100, 100, (3, H, W)).astype(np.float32)


@pytest.fixture(scope="module")
def warps() -> tuple[np.ndarray, np.ndarray]:
    """Return sources that stand to the left and to the right, turned a little."""
    turn = np.array([[1, 0.01, 0.02], [-0.01, 1, 0.015], [-0.02, -0.015, 1]])
    h_inf = np.stack([K @ turn @ np.linalg.inv(K), K @ turn.T @ np.linalg.inv(K)])
    return h_inf, np.array([[0.2, 0.02, 0.03], [-0.15, 0.05, -0.02]]) @ K.T


def bilinear(image: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    x, y = np.clip(u - 0.5, 0, W - 1.001), np.clip(v - 0.5, 0, H - 1.001)
    i, j = x.astype(int), y.astype(int)
    fx, fy = x - i, y - j
    top = image[j, i] * (1 - fx) + image[j, i + 1] * fx
    low = image[j + 1, i] * (1 - fx) + image[j + 1, i + 1] * fx
    return top * (1 - fy) + low * fy


def correlation(a: np.ndarray, b: np.ndarray, weight: np.ndarray) -> float:
    a, b = a - (weight * a).sum(), b - (weight * b).sum()
    va, vb = (weight * a * a).sum(), (weight * b * b).sum()
    return float((weight * a * b).sum() / np.sqrt((va + NOISE**2) * (vb + NOISE**2)))


def test_sweep_is_the_mean_of_the_two_best_correlations(images, warps) -> None:
    h_inf, shift = warps
    rhos = np.array([0.2, 0.9])
    cost = np.empty((2, H, W), np.uint8)
    sweep_costs(images[0], images[1:], h_inf, shift, rhos, NOISE, cost)
    y, x = np.mgrid[:H, :W]
    pixels = np.stack([x + 0.5, y + 0.5, np.ones((H, W))], -1)
    for d, rho in enumerate(rhos):
        projected = [pixels @ m.T + rho * t for m, t in zip(h_inf, shift)]
        u, v = (np.stack([p[..., a] / p[..., 2] for p in projected]) for a in (0, 1))
        warped = [bilinear(image, *at) for image, at in zip(images[1:], zip(u, v))]
        seen = ((u > 0) & (u < W) & (v > 0) & (v < H)).all(0)
        assert seen.mean() > 0.3
        for row, column in np.argwhere(seen)[::7]:
            box = (slice(max(0, row - 2), row + 3), slice(max(0, column - 2), column + 3))
            weight = np.full(images[0][box].shape, 1.0 / images[0][box].size)
            score = np.mean([correlation(images[0][box], b[box], weight) for b in warped])
            assert cost[d, row, column] == pytest.approx(127 * (1 - score), abs=1.1)


def test_parts_with_the_same_sources_are_the_whole(images) -> None:
    camera = Camera(W, H, 40.0, 40.0, W / 2, H / 2)
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[1:, 0, 3] = 0.2, -0.15
    posed = SimpleNamespace(world_from_camera=poses)
    rhos = np.array([0.2, 0.6, 0.9])
    plan = ViewPlan(np.tile(np.array([1, 2]), (3, 4, 1)), np.zeros((3, 0)), np.ones(3), np.ones(3))
    parts = sweep_frame(0, images, posed, camera, plan, rhos, NOISE)
    whole = np.empty((3, H, W), np.uint8)
    h_inf, shift = plane_warps(posed, camera, 0, np.array([1, 2]))
    sweep_costs(images[0], images[1:], h_inf, shift, rhos, NOISE, whole)
    # Windows at the frame's border are clipped alike, sums run in another order.
    assert np.abs(parts.astype(int) - np.moveaxis(whole, 0, 2)).max() <= 1
    fitted, slope = np.full((H, W), 0.5, np.float32), np.zeros((H, W), np.float32)
    bounds = [np.array(part) for part in frame_parts(H, W)]
    assert np.add.reduce([(b[1] - b[0]) * (b[3] - b[2]) for b in bounds]) == H * W
    refined = []
    for parts in ([np.array([0, H, 0, W])], bounds):
        rho, score = np.full((H, W), -1, np.float32), np.full((H, W), -9, np.float32)
        for part in parts:
            refine(
                images[0], images[1:], h_inf, shift, fitted, slope, slope, 0.7, True, NOISE, part, rho, score
            )  # fmt: skip
        refined.append((rho, score))
    assert np.array_equal(refined[0], refined[1])


def test_part_without_sources_has_no_evidence(images) -> None:
    camera = Camera(W, H, 40.0, 40.0, W / 2, H / 2)
    sources = np.array([[[1, 2], [-1, -1], [1, -1], [2, 1]]])
    plan = ViewPlan(sources, np.zeros((1, 0)), np.ones(1), np.ones(1))
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[1:, 0, 3] = 0.2, -0.15
    cost = sweep_frame(
        0, images, SimpleNamespace(world_from_camera=poses), camera, plan, np.array([0.2, 0.9]), NOISE
    )
    top, bottom, left, right = frame_parts(H, W)[1]
    assert (cost[top:bottom, left:right] == 127).all()
    assert cost[: H // 2, : W // 2].std() > 10


def test_slanted_window_correlates_as_written_out(images, warps) -> None:
    h_inf, shift = warps
    dx, dy = offsets(3, 2)
    rng = np.random.default_rng(1)
    weight = rng.uniform(0.2, 1, len(dx)).astype(np.float32)
    weight /= weight.sum()
    y, x, rho, gx, gy = 14, 19, 0.5, 0.01, -0.02
    values = images[0][y + dy.astype(int), x + dx.astype(int)]
    mean = (weight * values).sum()
    variance = np.float32((weight * (values - mean) ** 2).sum() + NOISE**2)
    maps = source_maps(h_inf, shift)
    project(h_inf, y, x, maps)
    pixels = np.stack([x + 0.5 + dx, y + 0.5 + dy, np.ones(len(dx))], 1)
    for k in range(2):
        at = pixels @ h_inf[k].T + (rho + gx * dx + gy * dy)[:, None] * shift[k]
        expected = correlation(
            values, bilinear(images[k + 1], at[:, 0] / at[:, 2], at[:, 1] / at[:, 2]), weight
        )
        got = make_correlate(len(dx))(
            weight, (weight * (values - mean)).astype(np.float32), variance, images[k + 1].ravel(), H, W,
            maps[k], np.float32(rho), np.float32(gx), np.float32(gy), np.float32(NOISE**2), dx, dy,
        )  # fmt: skip
        assert got == pytest.approx(expected, abs=1e-4)


def test_slopes_of_a_plane_are_found_and_stop_at_a_jump() -> None:
    y, x = np.mgrid[:H, :W]
    rho = (1.0 + 0.004 * x - 0.003 * y).astype(np.float32)
    rho[:, 20:] += 2.0
    fitted, gx, gy = (np.empty((H, W), np.float32) for _ in range(3))
    fit_slopes(rho, 0.012, fitted, gx, gy)
    assert np.abs(gx - 0.004).max() < 1e-5
    assert np.abs(gy + 0.003).max() < 1e-5
    assert np.abs(fitted - rho).max() < 1e-5


def test_views_are_compared_as_written_out() -> None:
    """A room's wall, seen by three views with noise and holes: each pixel there and back, and what is beyond."""
    rng = np.random.default_rng(2)
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[1:, :3, 3] = (0.2, 0.02, 0.05), (-0.1, 0.0, -0.04)
    depth = rng.uniform(1.9, 2.1, (3, H, W)).astype(np.float32)
    depth[:, :, W // 2 :] = 2.0
    depth[rng.uniform(size=depth.shape) < 0.1] = 0
    weight = rng.uniform(0, 1, depth.shape).astype(np.float32)
    relative = np.linalg.inv(poses[1:]) @ poses[0]
    mask = rng.uniform(size=(H, W)) < 0.8
    agree, through, count = (np.zeros((H, W), np.uint8) for _ in range(3))
    fused = np.zeros((H, W), np.float32)
    k, rows = (40.0, 40.0, W / 2, H / 2), np.array([1, 2, -1])
    count_witnesses(0, rows, depth, mask, relative, k, 1.02, 0.01, agree, through)
    check_view(0, rows, depth, weight, mask, relative, k, 0.03, 1.0, count, fused)
    for y, x in np.argwhere(mask & (depth[0] > 0)):
        z, seen = float(depth[0, y, x]), []
        for j, m in zip(rows, relative):
            there = K @ (m[:3, :3] @ np.linalg.inv(K) @ [z * (x + 0.5), z * (y + 0.5), z] + m[:3, 3])
            u, v = there[:2] / there[2]
            if 1 <= u < W - 1 and 1 <= v < H - 1:
                seen.append((j, m, u, v, there[2]))
        if len(seen) < 2:
            continue
        direct = [float(depth[j, int(v), int(u)]) / far for j, _, u, v, far in seen]
        assert agree[y, x] == sum(abs(d - 1) < 0.01 for d in direct)
        assert through[y, x] == sum(d > 1.02 for d in direct)
        own, sums = weight[0, y, x] + 1e-3, []
        for j, m, u, v, far in seen:
            i, t = int(u - 0.5), int(v - 0.5)
            four = depth[j, t : t + 2, i : i + 2]
            near = four.min() > 0 and four.max() - four.min() < 0.03 * four.min()
            d = bilinear(depth[j], np.array(u), np.array(v)) if near else depth[j, int(v), int(u)]
            back = K @ (m[:3, :3].T @ (np.linalg.inv(K) @ [u * d, v * d, d] - m[:3, 3]))
            off = np.hypot(*(back[:2] / back[2] - [x + 0.5, y + 0.5])) if d > 0 else np.inf
            if d > 0 and abs(d - far) <= 0.03 * far and off <= 1.0:
                sums.append((weight[j, int(v), int(u)] + 1e-3, back[2]))
        assert count[y, x] == len(sums)
        total = own / z + sum(q / far for q, far in sums)
        assert fused[y, x] == pytest.approx((own + sum(q for q, _ in sums)) / total, rel=1e-5)
    assert (count[mask] == 2).mean() > 0.2
    assert (through[mask] > 0).any()
    assert not count[~mask].any()
