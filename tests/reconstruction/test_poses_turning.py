"""Cameras of a visitor who turns on the spot, and parts of a model that hardly anything joins."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.sparse import csr_array
from test_poses import camera_errors_m

from reconstruction.frames import load_frames
from reconstruction.frames.config import FramesConfig
from reconstruction.poses import PosesConfig, estimate_poses
from reconstruction.poses.refine import largest_linked_part
from synthetic.benchmark_capture import CaptureSpec, stage
from synthetic.film import iterate_film
from synthetic.procedural import RoomSpec
from synthetic.videos import write_video


@pytest.mark.unit
def test_parts_joined_by_few_points_are_two():
    sees = np.zeros((7, 100), np.int32)
    sees[:4, :40] = 1
    sees[4:, 50:] = 1
    sees[2:6, 40:49] = 1  # nine points that both parts see
    assert largest_linked_part(csr_array(sees)).tolist() == [True] * 4 + [False] * 3


@pytest.fixture(scope="module")
def visit(tmp_path_factory) -> tuple[Path, np.ndarray]:
    """A film of a visitor who turns around on the spot, and its true cameras (n, 4, 4)."""
    room = RoomSpec(seed=4, objects=12, walls=4, step_m=0.04)
    spec = CaptureSpec(room, frames=150, width=480, height=360, path="visit", fov_deg=66, seed=4)
    scene = stage(spec)
    path = tmp_path_factory.mktemp("visit") / "visit.mp4"
    film = iterate_film(scene.film_set, scene.camera, scene.world_from_camera, spec.sensor(), seed=4)
    write_video(path, film, spec.fps, crf=23)
    return path, scene.world_from_camera


@pytest.mark.stage
def test_who_turns_on_the_spot_is_followed(visit, tmp_path, small_capture):
    path, true = visit
    frames = load_frames(path, FramesConfig())
    posed = estimate_poses(frames, PosesConfig(), work_dir=tmp_path)
    truth = replace(
        small_capture.posed, world_from_camera=true[posed.indices], indices=posed.indices,
        images=posed.images, times_s=posed.times_s, sharpness=posed.sharpness, observations=posed.observations,
        held_out_world_from_camera=true[posed.held_out_indices], held_out_indices=posed.held_out_indices,
        held_out_images=posed.held_out_images, held_out_times_s=posed.held_out_times_s,
    )  # fmt: skip
    errors, _, _ = camera_errors_m(posed, truth)
    assert len(posed.images) >= 0.9 * len(frames.images)
    assert np.sqrt((errors**2).mean()) < 0.03
