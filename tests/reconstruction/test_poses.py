"""Poses of a filmed room with known cameras, and inputs that cannot have any."""

from dataclasses import replace

import cv2
import numpy as np
import pycolmap
import pytest

from reconstruction.core.types import FrameSet, PosedFrames
from reconstruction.poses import POSES_PRESETS, PosesConfig, estimate_poses
from reconstruction.poses.diagnose import check_model, is_collapsed
from reconstruction.poses.lens import Lens
from reconstruction.poses.undistort import undistort
from registry.errors import InputError
from registry.geometry import split_similarity, umeyama
from synthetic.camera_paths import pan_path
from synthetic.videos import short_film

pytestmark = pytest.mark.stage


class Notes:
    """Collects what the stage reports."""

    def __init__(self) -> None:
        self.notes: list[str] = []
        self.counts: dict[str, list[int]] = {}

    def start(self, total: int, label: str) -> None:
        self.label = label
        self.counts[label] = [0, total]

    def advance(self, n: int = 1) -> None:
        self.counts[self.label][0] += n

    def note(self, message: str) -> None:
        self.notes.append(message)


def frame_set(images: np.ndarray, like: FrameSet) -> FrameSet:
    """Return a video of other keyframes, with nothing held out."""
    n = len(images)
    empty = np.zeros((0, *images.shape[1:]), np.uint8)
    return replace(
        like, images=images, indices=np.arange(1, n + 1, dtype=np.int32), times_s=np.arange(n) / 12.0,
        sharpness=np.ones(n, np.float32), held_out_images=empty, held_out_indices=np.zeros(0, np.int32),
        held_out_times_s=np.zeros(0),
    )  # fmt: skip


def camera_errors_m(estimated: PosedFrames, truth: PosedFrames) -> tuple[np.ndarray, np.ndarray, float]:
    """Return position errors of keyframes and of held-out frames, and the mean rotation error in degrees."""
    rows = np.searchsorted(truth.indices, estimated.indices)
    held = np.searchsorted(truth.held_out_indices, estimated.held_out_indices)
    ours, true = estimated.world_from_camera, truth.world_from_camera[rows]
    align = umeyama(ours[:, :3, 3], true[:, :3, 3])
    _, rotation, _ = split_similarity(align)

    def error(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.linalg.norm(a[:, :3, 3] @ align[:3, :3].T + align[:3, 3] - b[:, :3, 3], axis=1)

    turned = np.swapaxes(rotation @ ours[:, :3, :3], 1, 2) @ true[:, :3, :3]
    angle = np.arccos(np.clip((np.trace(turned, axis1=1, axis2=2) - 1) / 2, -1, 1))
    held_out = error(estimated.held_out_world_from_camera, truth.held_out_world_from_camera[held])
    return error(ours, true), held_out, float(np.degrees(angle.mean()))


@pytest.fixture(scope="module")
def frames(small_capture) -> FrameSet:
    return small_capture.frame_set()


@pytest.fixture(scope="module")
def posed(frames, tmp_path_factory) -> PosedFrames:
    return estimate_poses(frames, PosesConfig(), work_dir=tmp_path_factory.mktemp("poses"))


def test_cameras_are_where_they_were(posed, small_capture):
    errors, held_out, angle_deg = camera_errors_m(posed, small_capture.posed)
    assert len(posed.images) == posed.chosen_frames == len(small_capture.posed.images)
    assert np.sqrt((errors**2).mean()) < 0.004
    assert len(held_out) == len(small_capture.posed.held_out_images)
    assert held_out.max() < 0.008
    assert angle_deg < 0.5
    assert posed.camera.fx == pytest.approx(small_capture.posed.camera.fx, rel=0.02)


@pytest.mark.parametrize("factor", [1.6, 0.65, 40.0])
def test_a_wrong_focal_length_in_the_metadata_does_no_harm(frames, small_capture, tmp_path, factor):
    wrong = replace(frames, focal_prior_px=factor * small_capture.posed.camera.fx)
    posed = estimate_poses(wrong, PosesConfig(), work_dir=tmp_path)
    errors, _, _ = camera_errors_m(posed, small_capture.posed)
    assert len(posed.images) == posed.chosen_frames
    assert np.sqrt((errors**2).mean()) < 0.006
    assert posed.camera.fx == pytest.approx(small_capture.posed.camera.fx, rel=0.03)


def test_observations_and_points_agree_with_the_cameras(posed):
    frame, point = posed.observations.T
    assert len(posed.points) > 200
    assert np.bincount(point, minlength=len(posed.points)).min() >= PosesConfig().min_track_length
    local = np.einsum(
        "oij,oj->oi",
        np.linalg.inv(posed.world_from_camera)[frame],
        np.column_stack([posed.points[point], np.ones(len(point))]),
    )
    u = posed.camera.fx * local[:, 0] / local[:, 2] + posed.camera.cx
    v = posed.camera.fy * local[:, 1] / local[:, 2] + posed.camera.cy
    assert (local[:, 2] > 0).all()
    assert ((u > -2) & (u < posed.camera.width + 2) & (v > -2) & (v < posed.camera.height + 2)).all()
    assert posed.reprojection_error_px < 0.5
    assert posed.point_errors_px.max() <= PosesConfig().max_point_error_px
    # The color at the projection is the point's color, give or take texture and noise.
    seen = posed.images[
        frame, v.clip(0, posed.camera.height - 1).astype(int), u.clip(0, posed.camera.width - 1).astype(int)
    ]
    assert np.median(np.abs(seen.astype(int) - posed.point_colors[point])) < 12


def test_same_input_gives_same_bits_and_held_out_frames_take_no_part(frames, posed, tmp_path, capfd):
    noise = np.random.default_rng(0).integers(0, 255, frames.held_out_images.shape, np.uint8)
    report = Notes()
    again = estimate_poses(
        replace(frames, held_out_images=noise), PosesConfig(), work_dir=tmp_path, progress=report
    )
    assert np.array_equal(again.world_from_camera, posed.world_from_camera)
    assert np.array_equal(again.points, posed.points)
    assert np.array_equal(again.observations, posed.observations)
    assert again.camera == posed.camera
    assert len(again.held_out_images) == 0  # noise cannot be located
    assert any("held-out" in note for note in report.notes)
    assert capfd.readouterr().err == ""  # COLMAP's log is in the folder, not on the terminal
    assert list(tmp_path.glob("colmap_info*"))
    assert all(done == total for done, total in report.counts.values()), report.counts


def test_ruined_frames_are_dropped_and_named(frames, tmp_path):
    images = frames.images.copy()
    for row in (3, 7):
        images[row] = cv2.GaussianBlur(images[row], (0, 0), 25)
    report = Notes()
    posed = estimate_poses(replace(frames, images=images), PosesConfig(), work_dir=tmp_path, progress=report)
    assert set(posed.indices) == set(np.delete(frames.indices, [3, 7]))
    assert posed.chosen_frames == len(frames.images)
    dropped = [note for note in report.notes if "not registered" in note]
    assert all(str(frames.indices[row]) in dropped[0] for row in (3, 7))


def test_distorted_lens_is_straightened(frames, small_capture, tmp_path):
    lens = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", 1.0, 320, 240)
    camera = small_capture.posed.camera
    lens.params = [camera.fx, camera.cx, camera.cy, -0.08]
    images = distort(frames.images, lens)
    posed = estimate_poses(
        replace(frames, images=images, held_out_images=distort(frames.held_out_images, lens)),
        PosesConfig(),
        work_dir=tmp_path,
    )
    errors, _, _ = camera_errors_m(posed, small_capture.posed)
    assert len(posed.images) >= 11
    assert np.sqrt((errors**2).mean()) < 0.008
    assert not np.array_equal(posed.images[5], images[list(frames.indices).index(posed.indices[5])])
    recorded = images[list(frames.indices).index(posed.indices[5])].astype(float)
    grid = np.stack(np.meshgrid(np.arange(10, 310) + 0.5, np.arange(10, 230) + 0.5), -1)
    there = Lens.of(posed).straightened(grid.reshape(-1, 2)).reshape(grid.shape).astype(np.float32)

    def apart(shift) -> float:
        """Return the mean color difference of the recorded and the undistorted frame, mapped with an offset."""
        source = there - np.float32(0.5) + np.array(shift, np.float32)
        filmed = cv2.remap(posed.images[5], source, None, cv2.INTER_LINEAR)
        return np.abs(filmed - recorded[10:230, 10:310]).mean()

    offsets = [(0.4, 0.0), (-0.4, 0.0), (0.0, 0.4), (0.0, -0.4)]
    assert apart((0.0, 0.0)) < min(apart(shift) for shift in offsets)


def distort(images: np.ndarray, lens) -> np.ndarray:
    """Show pinhole images (n, h, w, 3) as `lens` would, which has the same focal length."""
    u, v = np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5)
    rays = np.asarray(lens.cam_from_img(np.stack([u, v], -1).reshape(-1, 2)))
    source = rays * lens.focal_length_x + np.array([lens.principal_point_x, lens.principal_point_y]) - 0.5
    source = source.reshape(*u.shape, 2).astype(np.float32)
    return np.stack(
        [cv2.remap(i, source, None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT) for i in images]
    )


@pytest.mark.parametrize("k1", [-0.15, 0.1])
def test_undistorted_image_is_what_the_pinhole_camera_sees(k1):
    lens = pycolmap.Camera.create_from_model_name(1, "OPENCV", 1.0, 320, 240)
    lens.params = [260.0, 261.0, 158.0, 121.0, k1, 0.02, 0.001, -0.001]
    u, v = np.meshgrid(np.arange(320) + 0.5, np.arange(240) + 0.5)
    # The picture shows where each of its own pixels lies, so the result tells where it was sampled.
    image = np.stack([u / 320 * 255, v / 240 * 255, 0 * u], -1).round().astype(np.uint8)
    camera, (out,), _ = undistort(lens, [image[None]])
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], -1)
    expected = np.asarray(lens.img_from_cam(rays.reshape(-1, 3))).reshape(240, 320, 2)
    assert (expected > 0).all()
    assert (expected < [320, 240]).all()
    inner = (slice(4, -4), slice(4, -4))
    assert np.abs(out[0][inner][..., 0] / 255 * 320 - expected[inner][..., 0]).max() < 1.5
    assert np.abs(out[0][inner][..., 1] / 255 * 240 - expected[inner][..., 1]).max() < 1.5


def test_images_without_distortion_are_not_resampled(frames):
    lens = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", 266.0, 320, 240)
    camera, (out,), distorted = undistort(lens, [frames.images])
    assert out is frames.images
    assert distorted is None
    assert camera.fx == 266.0


def test_blank_frames_are_refused(frames, tmp_path):
    rng = np.random.default_rng(1)
    blank = np.clip(200 + rng.standard_normal((12, 240, 320, 3)), 0, 255).astype(np.uint8)
    blank = np.stack([cv2.GaussianBlur(i, (0, 0), 2) for i in blank])
    with pytest.raises(InputError, match="texture"):
        estimate_poses(frame_set(blank, frames), PosesConfig(), work_dir=tmp_path)


def test_camera_that_only_turns_is_refused(frames, tmp_path):
    film = short_film(14, path=pan_path(14))
    with pytest.raises(InputError, match="turned on the spot"):
        estimate_poses(frame_set(film, frames), PosesConfig(), work_dir=tmp_path)


def test_still_camera_is_refused(frames, tmp_path):
    rng = np.random.default_rng(2)
    noise = rng.integers(-2, 3, (10, 240, 320, 3))
    still = np.clip(frames.images[0].astype(int) + noise, 0, 255).astype(np.uint8)
    with pytest.raises(InputError, match="stood still"):
        estimate_poses(frame_set(still, frames), PosesConfig(), work_dir=tmp_path)


def test_unrelated_pictures_are_refused(frames, tmp_path):
    rng = np.random.default_rng(3)
    pictures = [cv2.resize(rng.integers(0, 255, (30, 40, 3), np.uint8), (320, 240)) for _ in range(10)]
    with pytest.raises(InputError, match="matched"):
        estimate_poses(frame_set(np.stack(pictures), frames), PosesConfig(), work_dir=tmp_path)


def test_too_few_frames_are_refused(frames, tmp_path):
    with pytest.raises(InputError, match="at least 8"):
        estimate_poses(frame_set(frames.images[:5], frames), PosesConfig(), work_dir=tmp_path)


def test_presets_are_complete():
    assert set(POSES_PRESETS) == {"fast", "default", "quality"}
    assert POSES_PRESETS["default"] == PosesConfig()


def test_a_model_with_a_part_that_shrank_to_a_point_is_refused():
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig, options.num_points3D = (
        1,
        1,
        12,
        200,
    )
    model = pycolmap.synthesize_dataset(options)
    assert not is_collapsed(model)
    check_model(model, 12, np.arange(12), 0.5)
    ids = sorted(model.point3D_ids())
    for image_id in (
        3,
        4,
        5,
    ):  # a third of the points goes to each of them, a hundred thousandth of the way off
        center = model.image(image_id).projection_center()
        for point_id in ids[image_id::6]:
            point = model.point3D(point_id)
            point.xyz = center + 1e-5 * (point.xyz - center)
    assert is_collapsed(model)
    with pytest.raises(InputError, match="shrank to a point"):
        check_model(model, 12, np.arange(12), 0.5)
