"""Cameras of a visitor who turns on the spot, and parts of a model that hardly anything joins."""

import numpy as np
import pytest
from scipy.sparse import csr_array

from reconstruction.frames import load_frames
from reconstruction.frames.config import FramesConfig
from reconstruction.measure.alignment import align
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


@pytest.mark.stage
def test_cameras_of_a_film_that_turns_on_the_spot(tmp_path):
    """Without the alignment of patches they are 1.1 cm off (RMSE)."""
    room = RoomSpec(seed=2, objects=8, walls=4, step_m=0.04, textureless_share=0.3)
    spec = CaptureSpec(
        room, frames=120, width=320, height=240, path="visit", fov_deg=66, seed=3, motion_blur_s=0.02
    )
    scene = stage(spec)
    film = iterate_film(scene.film_set, scene.camera, scene.world_from_camera, spec.sensor(), seed=3)
    write_video(tmp_path / "visit.mp4", film, spec.fps, crf=23)
    frames = load_frames(tmp_path / "visit.mp4", FramesConfig())
    posed = estimate_poses(frames, PosesConfig(), work_dir=tmp_path)
    found = dict(zip(posed.indices.tolist(), posed.world_from_camera))
    assert len(found) >= 0.9 * len(frames.images)
    assert align(found, dict(enumerate(scene.world_from_camera))).ate_cm < 0.7
