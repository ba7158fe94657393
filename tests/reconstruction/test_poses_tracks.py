"""Points that are followed through a film, and cameras of a visitor who turns on the spot."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.sparse import csr_array
from test_poses import camera_errors_m

from reconstruction.core.progress import NO_PROGRESS
from reconstruction.core.types import FrameSet
from reconstruction.frames import load_frames
from reconstruction.frames.config import FramesConfig
from reconstruction.poses import PosesConfig, estimate_poses
from reconstruction.poses.estimate import initial_camera
from reconstruction.poses.features import Features
from reconstruction.poses.refine import largest_linked_part
from reconstruction.poses.tracks import follow, with_tracks
from synthetic.benchmark_capture import CaptureSpec, stage
from synthetic.film import iterate_film
from synthetic.procedural import RoomSpec
from synthetic.videos import write_video

SHIFT = np.array([3.25, -1.5])  # pixels a frame


def moving_picture(frames: int) -> list[np.ndarray]:
    """Return gray images (180, 240) of blobs before a plain wall that move by `SHIFT` a frame, and of one edge."""
    rng = np.random.default_rng(0)
    blobs = [(rng.uniform(20, 150), rng.uniform(60, 120), rng.uniform(40, 200)) for _ in range(25)]
    y, x = np.mgrid[:180, :240].astype(np.float64)
    out = []
    for number in range(frames):
        image = np.full((180, 240), 120.0)
        for cx, cy, level in blobs:
            distance = (x - cx - number * SHIFT[0]) ** 2 + (y - cy - number * SHIFT[1]) ** 2
            image += (level - 120) * np.exp(-distance / 18)
        image[170:] = 30  # an edge along which a point could slide
        out.append(image.round().clip(0, 255).astype(np.uint8))
    return out


@pytest.fixture
def film(small_capture) -> tuple[FrameSet, list[tuple[int, np.ndarray]]]:
    """Return keyframes 1, 4, 7 and 10 of a film, and all frames from 1 to 10."""
    images = list(enumerate(moving_picture(12)))[1:11]
    frames = small_capture.frame_set()
    return replace(
        frames, images=frames.images[:4], indices=np.array([1, 4, 7, 10], np.int32),
        times_s=frames.times_s[:4], sharpness=frames.sharpness[:4],
    ), images  # fmt: skip


@pytest.mark.unit
def test_points_move_with_the_picture_and_keep_their_number(film):
    frames, images = film
    tracks = follow(frames, np.ones(4, bool), images, NO_PROGRESS)
    for row in range(3):
        numbers, a, b = np.intersect1d(tracks.numbers[row], tracks.numbers[row + 1], return_indices=True)
        assert len(numbers) >= 15
        moved = tracks.pixels[row + 1][b] - tracks.pixels[row][a]
        assert np.abs(np.median(moved, axis=0) - 3 * SHIFT).max() < 0.05
        assert (np.linalg.norm(moved - 3 * SHIFT, axis=1) < 0.5).mean() > 0.9
    assert all((pixels[:, 1] < 165).all() for pixels in tracks.pixels.values()), "a point lies on the edge"


@pytest.mark.unit
def test_tracks_end_where_a_keyframe_is_left_out(film):
    frames, images = film
    tracks = follow(frames, np.array([True, True, False, True]), images, NO_PROGRESS)
    assert set(tracks.numbers) == {0, 1, 3}
    assert np.isin(tracks.numbers[1], tracks.numbers[0]).any()
    assert not np.isin(tracks.numbers[3], tracks.numbers[1]).any()


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


@pytest.mark.unit
def test_a_film_that_is_gone_is_named(film, tmp_path):
    frames, _ = film
    gone = replace(frames, source=replace(frames.source, file=str(tmp_path / "gone.mp4")))
    notes: list[str] = []

    class Notes:
        def start(self, total: int, label: str) -> None: ...
        def advance(self, n: int = 1) -> None: ...
        def note(self, message: str) -> None:
            notes.append(message)

    config = PosesConfig()
    features = [
        Features(np.zeros((0, 2), np.float32), np.zeros(0, np.float32), np.zeros((0, 128), np.float32))
    ] * 4
    assert with_tracks(gone, features, [], initial_camera(gone, config), config, Notes()) == (features, [])
    assert "gone.mp4 is gone" in notes[0]
