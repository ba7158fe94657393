"""The stage as the pipeline runs it: depth maps corrected by what all frames agree on, and the move to world space."""

import dataclasses

import numpy as np
import pytest

from reconstruction.core.types import DepthMaps
from reconstruction.gaussians import (
    GaussiansConfig,
    make_gaussians,
    moved,
    read_ply,
    render_gaussians,
    write_ply,
)
from reconstruction.pipeline import STAGES
from registry.geometry import matrix_from_quat

pytestmark = pytest.mark.stage

CONFIG = GaussiansConfig(
    iterations=200, side_px=240, coarse_side_px=160, max_gaussians=20_000, densify_every=30, seed=3
)


def off_by(depth: np.ndarray, true: np.ndarray, share: float) -> float:
    known = (depth > 0) & (true > 0)
    return float((np.abs(depth[known] / true[known] - 1) > share).mean())


@pytest.fixture(scope="module")
def wrong(small_capture):
    """True depth but for noise, holes, and squares that one view alone has 8 % too near."""
    rng = np.random.default_rng(1)
    true = np.asarray(small_capture.depth.depth)
    z = true * (1 + 0.004 * rng.normal(size=true.shape)).astype(np.float32)
    side = max(4, true.shape[1] // 10)
    for row in z:
        for _ in range(4):
            y, x = rng.integers(0, true.shape[1] - side), rng.integers(0, true.shape[2] - side)
            row[y : y + side, x : x + side] *= 0.92
    confidence = np.where(true > 0, 2, 0).astype(np.uint8)
    confidence[:, ::7, ::5] = 0
    return DepthMaps(small_capture.depth.camera, z * (confidence > 0), confidence)


@pytest.fixture(scope="module")
def made(small_capture, wrong):
    return make_gaussians(small_capture.posed, wrong, CONFIG)


def test_depth_that_other_frames_contradict_is_corrected(small_capture, wrong, made):
    true = np.asarray(small_capture.depth.depth)
    before, after = off_by(wrong.depth, true, 0.05), off_by(made.depth.depth, true, 0.05)
    assert before > 0.025
    assert after < 0.7 * before
    error = np.abs(made.depth.depth / np.maximum(true, 1e-6) - 1)[(made.depth.depth > 0) & (true > 0)]
    assert np.median(error) < 0.0027  # that of the noise


def test_next_to_nothing_is_lost_and_nothing_is_invented(wrong, made):
    known = np.asarray(wrong.depth) > 0
    assert (made.depth.depth[~known] == 0).all()
    assert (made.depth.confidence[~known] == 0).all()
    assert (made.depth.depth[known] > 0).mean() > 0.93
    kept = made.depth.depth > 0
    assert np.array_equal(made.depth.confidence[kept], np.asarray(wrong.confidence)[kept])
    assert (made.depth.confidence[~kept] == 0).all()


def test_without_refinement_the_depth_maps_go_on_as_they_are(small_capture, wrong):
    plain = dataclasses.replace(CONFIG, iterations=2, refine_depth=False)
    assert make_gaussians(small_capture.posed, wrong, plain).depth is wrong


def test_moved_gaussians_look_the_same_from_the_moved_camera(small_capture, made):
    angle = 0.7
    rotation = matrix_from_quat(np.array([np.cos(angle / 2), 0, *(np.sin(angle / 2) * np.array([0.6, 0.8]))]))
    similarity = np.eye(4)
    similarity[:3, :3], similarity[:3, 3] = 2.5 * rotation, [1.0, -2.0, 0.5]
    there = moved(made.gaussians, similarity)
    camera = small_capture.posed.camera.resized(80, 60)
    here = render_gaussians(made.gaussians, camera, made.gaussians.world_from_camera[1])
    again = render_gaussians(there, camera, there.world_from_camera[1])
    # Rounding flips single pixels by up to a few gray levels; which, depends on the processor. All others are the same.
    off = np.abs(here.color - again.color)
    assert np.quantile(off, 0.999) < 1e-4
    assert off.max() < 4 / 255
    solid = here.opacity > 0.5
    off = np.abs(again.depth[solid] / here.depth[solid] / 2.5 - 1)
    assert np.quantile(off, 0.999) < 1e-4
    assert off.max() < 0.02


def test_moved_gaussians_survive_a_ply(made, tmp_path):
    similarity = np.diag([3.0, 3.0, 3.0, 1.0])
    there = moved(made.gaussians, similarity)
    write_ply(there, tmp_path / "room.ply")
    back = read_ply(tmp_path / "room.ply")
    assert np.array_equal(back.means, there.means)
    assert np.allclose(back.log_scales, made.gaussians.log_scales + np.log(3.0), atol=1e-6)


def test_another_scale_asks_for_no_other_fit():
    needs = {stage.name: stage.needs for stage in STAGES}
    assert "world" not in needs["gaussians"]
    assert {"gaussians", "world"} <= set(needs["surface"])
