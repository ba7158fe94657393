"""Exports of phone apps: their images, upright, and their poses, in metres, adjusted to the pictures."""

import json
import zipfile
from pathlib import Path

import cv2
import numpy as np
import pytest
from notes import Notes
from scipy.spatial.transform import Rotation

from reconstruction.cache import digest_input
from reconstruction.core.types import PosedFrames
from reconstruction.frames import FramesConfig, load_frames
from reconstruction.poses import PosesConfig, estimate_poses
from registry.errors import InputError

pytestmark = pytest.mark.stage

# ARKit's world has +y up.
ARKIT_FROM_WORLD = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])


def tracked(truth: PosedFrames, noise_m: float, noise_deg: float) -> np.ndarray:
    """Return the true cameras (n, 4, 4) in ARKit's world, as a phone that is a little wrong would track them."""
    rng = np.random.default_rng(0)
    out = truth.world_from_camera.copy()
    for pose in out:
        turn = Rotation.from_rotvec(np.radians(noise_deg) * rng.standard_normal(3) / np.sqrt(3)).as_matrix()
        pose[:3, :3] = ARKIT_FROM_WORLD @ pose[:3, :3] @ turn
        pose[:3, 3] = ARKIT_FROM_WORLD @ (pose[:3, 3] + noise_m * rng.standard_normal(3) / np.sqrt(3))
    return out


def write_polycam(folder: Path, truth: PosedFrames, poses: np.ndarray, *, sideways: bool) -> None:
    """Write the raw export; a phone held upright stores pictures that lie on their side."""
    (folder / "keyframes" / "images").mkdir(parents=True)
    (folder / "keyframes" / "cameras").mkdir()
    c = truth.camera
    for number, (image, pose) in enumerate(zip(truth.images, poses)):
        right, down, forward, position = pose[:3].T
        fx, cx, cy, width, height = c.fx * (1 + 0.002 * (-1) ** number), c.cx, c.cy, c.width, c.height
        if sideways:  # turned clockwise: what was up is on the right
            image, right, down = np.rot90(image, -1), -down, right
            cx, cy, width, height = c.height - c.cy, c.cx, c.height, c.width
        matrix = np.stack([right, -down, -forward, position], axis=1)
        data = {f"t_{r}{k}": matrix[r, k] for r in range(3) for k in range(4)}
        lens = {"fx": fx, "fy": fx, "cx": cx, "cy": cy, "width": width, "height": height, "timestamp": number}
        name = f"{1000 + 17 * number}"
        (folder / "keyframes" / "cameras" / f"{name}.json").write_text(json.dumps({**data, **lens}))
        cv2.imwrite(str(folder / "keyframes" / "images" / f"{name}.png"), image[..., ::-1])


def write_r3d(path: Path, truth: PosedFrames, poses: np.ndarray, *, roll: bool) -> None:
    """Write a recording; in some versions of the app the axes are those of the phone held the other way."""
    rows, c = [], truth.camera
    for pose in poses:
        right, down, forward, position = pose[:3].T
        right, down = (down, -right) if roll else (right, down)
        quaternion = Rotation.from_matrix(np.stack([right, -down, -forward], axis=1)).as_quat()
        rows.append([*quaternion.tolist(), *position.tolist()])
    k = [c.fx, 0, 0, 0, c.fy, 0, c.cx, c.cy, 1]
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(
            "metadata", json.dumps({"w": c.width, "h": c.height, "K": k, "poses": rows, "fps": 30})
        )
        for number, image in enumerate(truth.images):
            archive.writestr(
                f"rgbd/{number}.jpg", cv2.imencode(".jpg", image[..., ::-1], [1, 97])[1].tobytes()
            )
            archive.writestr(f"rgbd/{number}.depth", b"")


def reconstruct(path: Path, work: Path) -> tuple[PosedFrames, list[str]]:
    report = Notes()
    frames = load_frames(path, FramesConfig(), progress=report)
    return estimate_poses(frames, PosesConfig(), work_dir=work, progress=report), report.notes


def check(posed: PosedFrames, truth: PosedFrames, poses: np.ndarray) -> None:
    """Compare with the truth: adjusted cameras are better than those of the phone, at the phone's scale."""
    assert posed.metric
    assert len(posed.images) == len(truth.images)
    true = truth.world_from_camera[:, :3, 3] @ ARKIT_FROM_WORLD.T
    centers = posed.world_from_camera[:, :3, 3]
    length = np.linalg.norm(np.diff(true, axis=0), axis=1).sum()
    assert np.linalg.norm(np.diff(centers, axis=0), axis=1).sum() == pytest.approx(length, rel=0.02)
    error = np.linalg.norm(centers - centers.mean(0) - (true - true.mean(0)), axis=1)
    before = np.linalg.norm(poses[:, :3, 3] - poses[:, :3, 3].mean(0) - (true - true.mean(0)), axis=1)
    assert error.mean() < 0.7 * before.mean()
    down = posed.world_from_camera[:, :3, 1] @ ARKIT_FROM_WORLD
    assert np.einsum("ij,ij->i", down, truth.world_from_camera[:, :3, 1]).min() > np.cos(np.radians(4))
    assert posed.camera.fx == pytest.approx(truth.camera.fx, rel=0.02)


@pytest.mark.parametrize("sideways", [False, True])
def test_polycam_folder_is_an_input_of_its_own(small_capture, tmp_path, sideways):
    truth = small_capture.posed
    poses = tracked(truth, 0.02, 1.0)
    write_polycam(tmp_path / "scan", truth, poses, sideways=sideways)
    posed, notes = reconstruct(tmp_path / "scan", tmp_path / "work")
    assert posed.images.shape[1:3] == (240, 320)
    assert any("turned by 270 degrees" in note for note in notes) == sideways
    assert any("focal length varies by 0.2 %" in note for note in notes)
    check(posed, truth, poses)


@pytest.mark.parametrize("roll", [False, True])
def test_record3d_file_is_an_input_of_its_own(small_capture, tmp_path, roll):
    truth = small_capture.posed
    poses = tracked(truth, 0.02, 1.0)
    write_r3d(tmp_path / "scan.r3d", truth, poses, roll=roll)
    posed, notes = reconstruct(tmp_path / "scan.r3d", tmp_path / "work")
    assert any("cameras turned by" in note for note in notes) == roll
    check(posed, truth, poses)


def test_unadjusted_poses_stay_as_they_were(small_capture, tmp_path):
    truth = small_capture.posed
    poses = tracked(truth, 0.0, 0.0)
    write_r3d(tmp_path / "scan.r3d", truth, poses, roll=False)
    frames = load_frames(tmp_path / "scan.r3d", FramesConfig())
    config = PosesConfig(refine_imported="never")
    posed = estimate_poses(frames, config, work_dir=tmp_path / "work")
    assert np.allclose(posed.world_from_camera, poses, atol=1e-9)


def test_a_recording_without_tracking_is_refused(small_capture, tmp_path):
    truth = small_capture.posed
    write_r3d(tmp_path / "scan.r3d", truth, np.tile(np.eye(4), (len(truth.images), 1, 1)), roll=False)
    with pytest.raises(InputError, match="no camera motion"):
        reconstruct(tmp_path / "scan.r3d", tmp_path / "work")


def test_a_changed_camera_file_changes_the_digest(small_capture, tmp_path):
    truth = small_capture.posed
    write_polycam(tmp_path, truth, truth.world_from_camera, sideways=False)
    before = digest_input(tmp_path)
    (tmp_path / "keyframes" / "cameras" / "1000.json").write_text("{}")
    assert digest_input(tmp_path) != before


def test_a_zip_with_a_folder_around_everything_is_found(small_capture, tmp_path):
    truth = small_capture.posed
    write_polycam(tmp_path / "scan", truth, tracked(truth, 0, 0), sideways=True)
    with zipfile.ZipFile(tmp_path / "scan.zip", "w") as archive:
        for file in sorted((tmp_path / "scan").rglob("*.*")):
            archive.write(file, f"my scan/{file.relative_to(tmp_path / 'scan')}")
    zipped = load_frames(tmp_path / "scan.zip", FramesConfig())
    folder = load_frames(tmp_path / "scan", FramesConfig())
    assert np.array_equal(zipped.images, folder.images)
    assert zipped.images.shape[1:3] == (240, 320)
