"""Fitting a generated room: better images, no worse depth, the same result every time."""

import dataclasses

import numpy as np
import pytest

from reconstruction.core.types import DepthMaps
from reconstruction.gaussians import GAUSSIANS_PRESETS, GaussiansConfig, evaluate_gaussians, fit_gaussians
from reconstruction.gaussians.backends import load_backend
from reconstruction.gaussians.fit import exponential, make_target, median_depth_of, settings_of
from reconstruction.gaussians.losses import weights_of
from reconstruction.gaussians.model import from_packed
from reconstruction.gaussians.optimizer import SplatState, prune, split
from reconstruction.gaussians.seeding import seed_from_depth
from registry.errors import InputError

pytestmark = pytest.mark.stage

SMALL = GaussiansConfig(
    iterations=120, side_px=160, coarse_side_px=120, max_gaussians=9000, densify_every=30, seed=3
)


@pytest.fixture(scope="module")
def noisy(small_capture):
    """The capture with depth as a sweep gives it: noise of 1 %, holes, and a darker frame."""
    rng = np.random.default_rng(0)
    depth = small_capture.depth
    z = np.asarray(depth.depth) * (1 + 0.01 * rng.normal(size=depth.depth.shape)).astype(np.float32)
    confidence = np.where(rng.uniform(size=z.shape) < 0.1, 0, depth.confidence).astype(np.uint8)
    images = small_capture.posed.images.copy()
    images[2] = (images[2] * 0.8).astype(np.uint8)
    posed = dataclasses.replace(small_capture.posed, images=images)
    return posed, DepthMaps(depth.camera, z * (confidence > 0), confidence)


@pytest.fixture(scope="module")
def fitted(noisy):
    return fit_gaussians(*noisy, SMALL)


def figures(gaussians, posed, truth, config=SMALL, unit=2.0):
    return evaluate_gaussians(gaussians, posed, truth, side_px=160, settings=settings_of(config, unit))


def test_fitting_makes_images_better_and_depth_better_than_the_input(noisy, fitted, small_capture):
    posed, depth = noisy
    unit = median_depth_of(depth)
    seeds = from_packed(seed_from_depth(posed, depth, 6000, 0.7))
    before = figures(seeds, posed, small_capture.held_out_depth, unit=unit)
    after = figures(fitted, posed, small_capture.held_out_depth, unit=unit)
    inside = 1  # the first kept-out frame looks beyond what the keyframes saw
    assert after.psnr_db[inside] > before.psnr_db[inside] + 3
    assert after.psnr_db[inside] > 25
    assert after.ssim[inside] > before.ssim[inside] + 0.05
    assert after.depth_error[inside] < 0.0067  # 1 % Gaussian noise has a median of 0.67 %
    assert len(fitted) <= SMALL.max_gaussians


def test_the_darker_frame_is_explained_by_its_exposure(fitted):
    gain = fitted.exposure_gain.mean(axis=1)
    others = np.delete(gain, 2)
    assert gain[2] < others.min() - 0.02


def test_the_same_seed_gives_the_same_gaussians(noisy, fitted):
    again = fit_gaussians(*noisy, SMALL)
    for field in dataclasses.fields(again):
        assert np.array_equal(getattr(again, field.name), getattr(fitted, field.name)), field.name


def test_the_result_does_not_depend_on_the_scale_of_the_input(noisy):
    posed, depth = noisy
    short = dataclasses.replace(SMALL, iterations=20)
    poses = posed.world_from_camera.copy()
    poses[:, :3, 3] *= 8
    plain = fit_gaussians(posed, depth, short)
    scaled = fit_gaussians(
        dataclasses.replace(posed, world_from_camera=poses),
        dataclasses.replace(depth, depth=depth.depth * 8),
        short,
    )
    # A factor of eight is exact in floating point, up to the rounding of logarithms.
    assert len(plain) == len(scaled)
    assert np.median(np.abs(scaled.means / 8 - plain.means)) < 1e-4


def test_pose_refinement_brings_a_camera_back(noisy):
    posed, depth = noisy
    moved = posed.world_from_camera.copy()
    moved[4] = moved[4] @ exponential(np.array([0.02, -0.01, 0.01, 0.004, 0.006, -0.004]))
    config = dataclasses.replace(SMALL, iterations=150, optimize_poses=True, pose_rate=1e-3)
    fitted = fit_gaussians(dataclasses.replace(posed, world_from_camera=moved), depth, config)

    def relative(poses):
        return np.linalg.inv(poses[3]) @ poses[4]

    truth = relative(posed.world_from_camera)
    before, after = (np.linalg.norm((relative(p) - truth)[:3, 3]) for p in (moved, fitted.world_from_camera))
    assert after < 0.6 * before


def test_seeds_stay_in_budget_and_on_the_surface(small_capture):
    for budget in (500, 4000):
        seeds = seed_from_depth(small_capture.posed, small_capture.depth, budget, 0.7)
        assert 0.5 * budget < len(seeds) <= budget
    camera, pose = small_capture.posed.camera, small_capture.posed.world_from_camera[0]
    local = (seeds[:, :3] - pose[:3, 3]) @ pose[:3, :3]
    u = np.floor(camera.fx * local[:, 0] / local[:, 2] + camera.cx).astype(int)
    v = np.floor(camera.fy * local[:, 1] / local[:, 2] + camera.cy).astype(int)
    inside = (local[:, 2] > 0) & (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
    error = local[inside, 2] - small_capture.depth.depth[0][v[inside], u[inside]]
    assert np.mean(error > -0.03) > 0.97  # nothing floats before the surface; hidden parts lie behind it


def test_splitting_keeps_mean_and_variance_and_goes_where_the_error_is(small_capture):
    state = SplatState.start(seed_from_depth(small_capture.posed, small_capture.depth, 1000, 0.7))
    n = len(state)
    state.parameters[:, 7] += 1.0  # clearly longer along the first axis
    state.seen[:], state.radius_px[:], state.error[7] = 1, 5.0, 10.0
    old = state.parameters[7].copy()
    assert split(state, dataclasses.replace(SMALL, max_gaussians=n + 5)) == 1
    halves = state.parameters[[7, n]]
    np.testing.assert_allclose(halves[:, :3].mean(0), old[:3], atol=1e-5)
    variance = np.exp(2 * halves[0, 7]) + 0.25 * np.sum((halves[0, :3] - halves[1, :3]) ** 2)
    assert variance == pytest.approx(np.exp(2 * old[7]), rel=0.02)


def test_pruning_drops_the_transparent_and_the_hidden(small_capture):
    state = SplatState.start(seed_from_depth(small_capture.posed, small_capture.depth, 500, 0.7))
    n = len(state)
    state.parameters[3, 9] = -6.0
    state.seen[5], state.contribution[5] = 10, 0.0
    assert prune(state, SMALL) == 2
    assert len(state) == n - 2
    assert len(state.error) == n - 2


def test_nothing_known_is_an_input_error(small_capture):
    blank = DepthMaps(
        small_capture.depth.camera,
        np.zeros_like(small_capture.depth.depth),
        np.zeros_like(small_capture.depth.confidence),
    )
    with pytest.raises(InputError, match="no depth map"):
        fit_gaussians(small_capture.posed, blank, SMALL)


def test_presets_and_limits():
    assert set(GAUSSIANS_PRESETS) == {"fast", "default", "quality"}
    with pytest.raises(ValueError, match="seed_share"):
        GaussiansConfig(seed_share=1.5)


@pytest.mark.gpu
def test_gsplat_agrees_with_the_cpu_in_image_and_derivatives(noisy):
    torch = pytest.importorskip("torch")
    pytest.importorskip("gsplat")
    if not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    posed, depth = noisy
    unit = median_depth_of(depth)
    p = seed_from_depth(posed, depth, 5000, 0.7)
    target = make_target(posed, depth, 0, 160, 0.2)
    weights, settings = (
        weights_of(dataclasses.replace(SMALL, distortion_weight=0.0)),
        settings_of(SMALL, unit),
    )
    results, renders = [], []
    for name in ("cpu", "gsplat"):
        backend = load_backend(name)
        pose = posed.world_from_camera[0]
        renders.append(backend.render(p, target.camera, pose, settings, np.ones(target.depth.shape)))
        results.append(backend.step(p, pose, target, np.ones(3), np.zeros(3), weights, settings))
    assert np.abs(renders[0].color - renders[1].color).mean() < 0.01
    assert np.corrcoef(renders[0].contribution, renders[1].contribution)[0, 1] > 0.99
    for name in ("l1", "ssim", "depth"):
        assert results[1].terms[name] == pytest.approx(results[0].terms[name], rel=0.1)
    for columns in (slice(0, 3), slice(9, 10), slice(10, 13)):
        a, b = (r.parameters[:, columns].ravel() for r in results)
        assert np.corrcoef(a, b)[0, 1] > 0.9
    assert np.corrcoef(results[0].pose, results[1].pose)[0, 1] > 0.9
