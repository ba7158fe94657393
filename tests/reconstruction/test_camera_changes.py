"""Cameras of phones that are not one pinhole camera with one pose a frame: rolling shutter, resection, zoom."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from notes import Notes
from scipy.spatial.transform import Rotation

from reconstruction.frames import FRAMES_PRESETS, load_frames
from reconstruction.poses import POSES_PRESETS, estimate_poses
from reconstruction.poses.lens import Lens
from reconstruction.poses.resection import resect
from reconstruction.poses.rolling_shutter import Motion, Shutter, moved, row_times
from reconstruction.poses.undistort import undistort
from reconstruction.poses.zoom import _scale_changes, longest_run
from synthetic.camera_paths import handheld_path, pan_path, phone_camera
from synthetic.film import film_room, prepare
from synthetic.room import build_room
from synthetic.sensor import Sensor
from synthetic.videos import write_video

_CLEAN = Sensor(noise=0.0, exposure_drift=0.0)


@pytest.fixture(scope="module")
def film_set():
    return prepare(build_room(0, step_m=0.08, density=0.5), shadow_px=256)


@pytest.mark.unit
def test_motion_is_the_velocity_in_camera_space():
    times = np.array([0.0, 0.1, 0.25, 0.3, 5.0])
    angular, linear = np.array([0.2, -0.4, 0.1]), np.array([0.5, 0.1, -0.2])
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(np.outer(times, angular)).as_matrix()
    poses[:, :3, 3] = np.outer(times, linear)
    found = Motion.of(times, poses)
    assert np.allclose(found.angular[1:3], angular)
    world = np.einsum("nij,nj->ni", poses[:, :3, :3], found.linear)
    assert np.allclose(world[1:3], linear)
    assert not found.linear[4].any(), "its neighbor is far in time"


@pytest.mark.unit
def test_moved_points_are_those_that_a_later_camera_sees():
    angular, linear, time_s = np.array([0.3, -0.2, 0.1]), np.array([0.4, 0.0, 0.2]), 0.02
    later = np.eye(4)
    later[:3, :3], later[:3, 3] = Rotation.from_rotvec(time_s * angular).as_matrix(), time_s * linear
    points = np.random.default_rng(0).uniform(1, 3, (20, 3))
    expected = (points - later[:3, 3]) @ later[:3, :3]
    assert np.allclose(moved(points, angular, linear, np.full(20, time_s)), expected)


@pytest.mark.unit
@pytest.mark.parametrize("turns", range(4))
def test_rows_are_read_from_the_top_of_the_stored_frame(turns):
    stored_rows = np.repeat(np.arange(6.0)[:, None], 8, axis=1)
    upright = np.rot90(stored_rows, turns)
    height, width = upright.shape
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    when = row_times(np.column_stack([x.ravel(), y.ravel()]), (width, height), 0.03, turns)
    assert np.allclose(when, 0.03 * ((upright.ravel() + 0.5) / 6 - 0.5))


@pytest.mark.stage
def test_a_straightened_frame_is_that_of_one_pose(film_set):
    import pycolmap

    camera, path = phone_camera(320, 240), pan_path(8, arc_deg=24.0)
    readout_s, frame_s = 0.03, 1 / 12
    bent = film_room(film_set, camera, path, replace(_CLEAN, rolling_shutter=readout_s / frame_s))
    true = film_room(film_set, camera, path, _CLEAN)
    times, row = np.arange(8) * frame_s, 4
    lens = pycolmap.Camera.create_from_model_name(1, "SIMPLE_PINHOLE", camera.fx, 320, 240)
    shutter = Shutter(readout_s, 0, lens, times, Motion.of(times, path), np.full(8, 1.6))
    straight = shutter.straightened(bent[row : row + 1], times[row : row + 1])[0]
    before, after = (
        np.abs(x[20:-20, 20:-20].astype(int) - true[row, 20:-20, 20:-20]).mean()
        for x in (bent[row], straight)
    )
    assert after < 0.6 * before, (after, before)


@pytest.mark.unit
def test_resection_finds_the_principal_point_beside_the_pose():
    import pycolmap

    camera = pycolmap.Camera.create_from_model_name(1, "RADIAL", 400.0, 480, 360)
    camera.params = [400.0, 240.0, 180.0, -0.05, 0.01]
    rng = np.random.default_rng(1)
    points = rng.uniform([-1.5, -1.0, 2.0], [1.5, 1.0, 5.0], (200, 3))
    true = np.array([9.0, -6.0])
    pixels = np.asarray(camera.img_from_cam(points)) + true + rng.normal(0, 0.3, (200, 2))
    pixels[:20] += rng.uniform(20, 60, (20, 2))  # wrong matches
    from_wrong_pose = Rotation.from_rotvec([0.01, 0.02, -0.01]).apply(points) + np.array([0.02, -0.01, 0.03])
    assert np.abs(resect(camera, from_wrong_pose, pixels, np.zeros(2)) - true).max() < 1.5


@pytest.mark.unit
def test_resection_leaves_out_points_beside_the_camera():
    import pycolmap

    camera = pycolmap.Camera.create_from_model_name(1, "RADIAL", 400.0, 480, 360)
    rng = np.random.default_rng(1)
    points = rng.uniform([-1.5, -1.0, 2.0], [1.5, 1.0, 5.0], (200, 3))
    points[:80] *= 1e-5  # as in a model that collapsed: one step of the derivative leads behind the camera
    true = np.array([9.0, -6.0])
    pixels = np.asarray(camera.img_from_cam(points)) + true
    assert np.abs(resect(camera, points, pixels, np.zeros(2)) - true).max() < 0.1


@pytest.mark.unit
def test_images_of_a_moving_crop_become_those_of_one_camera():
    import pycolmap

    camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", 150.0, 160, 120)
    u, v = np.meshgrid(np.arange(160) + 0.5, np.arange(120) + 0.5)
    offsets = np.array([[6.0, -4.0], [0.0, 0.0], [-5.0, 3.5]])

    def picture(offset: np.ndarray) -> np.ndarray:
        gray = 128 + 60 * np.sin((u - offset[0]) / 9) * np.cos((v - offset[1]) / 7)
        return np.repeat(gray[..., None], 3, axis=2).round().astype(np.uint8)

    images = np.stack([picture(offset) for offset in offsets])
    pinhole, (straight,), distorted = undistort(camera, [images], [offsets])
    assert 150 < pinhole.fx < 180
    assert np.abs(straight.astype(int) - straight[1]).max() <= 3
    lens = Lens(pinhole, distorted, (np.array([10, 20, 30]), offsets))
    seen = [
        lens.at(frame).straightened(np.array([[80.0, 60.0]]) + o)[0]
        for frame, o in zip((10, 20, 33), offsets)
    ]
    assert np.allclose(seen, [80.0, 60.0])


@pytest.mark.unit
def test_longest_run_has_one_level():
    values = np.array([1.0, 1.01, 0.99, 1.3, 1.6, 2.0, 2.02, 2.01, 1.99, 2.0])
    assert longest_run(values, 1.05) == (5, 9)
    assert longest_run(np.ones(4), 1.05) == (0, 3)


@pytest.mark.unit
@pytest.mark.parametrize(
    ("step", "gap_s", "changes"), [(2.0, 5.0, True), (1.04, 0.1, True), (1.04, 1.0, False)]
)
def test_sizes_of_matched_features_tell_a_change_of_scale(step, gap_s, changes):
    features = [SimpleNamespace(sizes=np.full(5, 3 * step**k)) for k in range(12)]
    matches = np.stack([np.arange(5), np.arange(5)], axis=1)
    pairs = [SimpleNamespace(rows=(k, k + 1), matches=matches) for k in range(11)]
    assert _scale_changes(np.arange(12) * gap_s, features, pairs) == changes


@pytest.mark.end_to_end
def test_of_a_zoomed_film_the_longer_part_is_used(film_set, tmp_path):
    path, near = handheld_path(48), phone_camera(320, 240)
    far = replace(near, fx=2 * near.fx, fy=2 * near.fy)
    film = [*film_room(film_set, near, path[:32]), *film_room(film_set, far, path[32:])]
    write_video(tmp_path / "v.mp4", film)
    notes = Notes()
    frames = load_frames(tmp_path / "v.mp4", FRAMES_PRESETS["fast"])
    posed = estimate_poses(frames, POSES_PRESETS["fast"], work_dir=tmp_path / "work", progress=notes)
    assert posed.indices.max() < 32
    assert len(posed.images) >= 0.9 * posed.chosen_frames
    assert posed.held_out_indices.max() < 32
    assert posed.camera.fx == pytest.approx(near.fx, rel=0.03)
    assert any("zoom" in note and "0.1-" in note for note in notes.notes)
