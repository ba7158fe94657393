"""One test a kernel: fixed input, timed in turns with the reference; the result is checked, so that work is done."""

import numpy as np
import pytest

from benchmarks.perf import inputs
from benchmarks.perf.reference import timer

pytestmark = pytest.mark.benchmark(timer=timer)


def test_rasterizer(measure):
    from reconstruction.core.rasterize import rasterize_mesh

    vertices, faces = inputs.bumpy_mesh()
    camera, pose = inputs.camera(640, 480), inputs.looking_down(1.5)
    raster = measure(lambda: rasterize_mesh(vertices, faces, camera, pose))
    assert (raster.face >= 0).mean() > 0.5


def test_plane_sweep(measure):
    from reconstruction.depth.sweep import sweep_costs

    images = inputs.textured_images(5, 160, 120)
    h_inf = np.repeat(np.eye(3)[None], 4, axis=0)
    shift = np.array([[-4.0 * (i + 1), 0, 0] for i in range(4)])
    rhos = np.linspace(0.0, 2.0, 32)
    cost = np.empty((32, 120, 160), np.uint8)
    measure(lambda: sweep_costs(images[0], images[1:], h_inf, shift, rhos, 1.5, cost))
    # The images are shifted as a plane at inverse depth 1 shows: that plane costs least in the middle.
    best = rhos[cost[:, 20:100, 40:120].argmin(axis=0)]
    assert abs(np.median(best) - 1.0) < 0.1


def test_sgm(measure):
    from reconstruction.depth.sgm import aggregate

    rng = np.random.default_rng(2)
    cost = rng.integers(90, 160, (120, 160, 32), np.uint8)
    cost[:, :, 11] = 60
    image = inputs.textured_images(1, 160, 120)[0]

    def setup() -> tuple:
        return (np.zeros(cost.shape, np.uint16),)

    def kernel(total: np.ndarray) -> np.ndarray:
        aggregate(cost, image, np.int32(8), np.int32(60), np.int32(9), 8.0, total)
        return total

    total = measure(kernel, setup)
    assert (total.argmin(axis=2) == 11).mean() > 0.99


def test_splats(measure):
    from reconstruction.gaussians.rasterizer import RasterSettings, rasterize, rasterize_backward

    packed, camera, pose = inputs.splats_on_a_sheet(), inputs.camera(320, 240), inputs.looking_down(1.5)
    slope = np.random.default_rng(4).standard_normal((240, 320, 9)).astype(np.float32)

    def kernel() -> tuple:
        image = rasterize(packed, camera, pose, RasterSettings())
        return image, rasterize_backward(image, slope)

    image, gradients = measure(kernel)
    assert (image.features[100:140, 140:180, 7] > 0.9).mean() > 0.6  # opacity
    assert np.abs(gradients.parameters).max() > 0


def test_tsdf_integrate(measure):
    from reconstruction.surface.pixels import prepare_views
    from reconstruction.surface.tsdf import BLOCK, integrate, surface_blocks, tile_reach

    depth, poses, images = inputs.depth_of_a_ball(8, inputs.camera(160, 120))
    views = prepare_views(depth, poses, images, reference_depth=1.5, max_depth=6.0, completed_weight=0.1)
    origin, voxel = np.array([-1.6, -1.6, -0.1]), 0.02
    shape = tuple(int(np.ceil(side / (BLOCK * voxel))) for side in (3.2, 3.2, 0.9))
    blocks = surface_blocks(views, poses, origin, shape, voxel, 4 * voxel)
    assert len(blocks) > 100
    reach = tile_reach(views, 4 * voxel)
    volume = measure(lambda: integrate(views, reach, blocks, origin, voxel, 4 * voxel, 0.0025))
    seen = volume.weight > 0
    assert 0.1 < seen.mean() < 1.0
    assert (volume.distance[seen] < 0).any()


def test_completion(measure):
    from reconstruction.assets.completion import complete
    from reconstruction.assets.config import AssetsConfig

    volume, frame = inputs.half_seen_can()
    field = measure(lambda: complete(volume, frame, AssetsConfig(), furniture=False))
    # Its unseen back is closed by symmetry: there is wall all around, at half its height.
    turn = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    wall = np.stack([0.038 * np.cos(turn), 0.038 * np.sin(turn), np.full(24, 0.055)], 1)
    cell = ((wall - field.origin) / field.voxel_m).astype(int)
    assert (field.distance[tuple(cell.T)] < 0).all()


def test_settle(measure):
    from registry.simulation import build_physics

    specs = inputs.pile()

    def kernel(physics: object) -> object:
        physics.step(120)
        return physics

    physics = measure(kernel, lambda: (build_physics(specs),))
    assert all(-0.01 < physics.pose(spec.id)[2, 3] < 0.5 for spec in specs if not spec.base)


@pytest.fixture
def room(tmp_path):
    """Return the hand-made room as an environment in state mode."""
    import simrecon_envs

    env = simrecon_envs.make("room", registry=inputs.room_registry(tmp_path))
    yield env
    env.close()


def test_env_step(measure, room):
    def setup() -> tuple:
        room.reset(seed=0)
        room.action_space.seed(0)
        return ([room.action_space.sample() for _ in range(20)],)

    def kernel(actions: list) -> object:
        for action in actions:
            observation, *_ = room.step(action)
        return observation

    assert np.isfinite(np.asarray(measure(kernel, setup))).all()
