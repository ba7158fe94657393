"""Poses from files come back as they were written, and fit the pictures."""

import json

import numpy as np
import pycolmap
import pytest

from reconstruction.core.types import PosedFrames
from reconstruction.poses import PosesConfig, estimate_poses
from registry.errors import UsageError
from registry.geometry import invert_rigid

pytestmark = pytest.mark.stage


def write_colmap_model(folder, truth: PosedFrames, size_factor: int = 1) -> None:
    """Write cameras of all frames as a COLMAP text model by hand, independent of the reader."""
    folder.mkdir()
    c = truth.camera.resized(truth.camera.width * size_factor, truth.camera.height * size_factor)
    (folder / "cameras.txt").write_text(f"1 PINHOLE {c.width} {c.height} {c.fx} {c.fy} {c.cx} {c.cy}\n")
    lines = []
    for number, (index, pose) in enumerate(zip(truth.indices, truth.world_from_camera)):
        camera_from_world = invert_rigid(pose)
        x, y, z, w = pycolmap.Rotation3d(camera_from_world[:3, :3]).quat
        t = camera_from_world[:3, 3]
        lines += [f"{number + 1} {w} {x} {y} {z} {t[0]} {t[1]} {t[2]} 1 frame_{index:05d}.jpg", ""]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    (folder / "points3D.txt").write_text("")


def write_transforms(path, truth: PosedFrames) -> None:
    """Write a nerfstudio file: the camera looks along -z with +y up."""
    c = truth.camera
    frames = []
    for index, pose in zip(truth.indices, truth.world_from_camera):
        right, down, forward, position = pose[:3].T
        matrix = np.eye(4)
        matrix[:3] = np.stack([right, -down, -forward, position], axis=1)
        frames.append({"file_path": f"images/frame_{index:05d}.png", "transform_matrix": matrix.tolist()})
    lens = {"w": c.width, "h": c.height, "fl_x": c.fx, "fl_y": c.fy, "cx": c.cx, "cy": c.cy}
    path.write_text(json.dumps({"camera_model": "OPENCV", **lens, "frames": frames}))


def check_against_truth(posed: PosedFrames, truth: PosedFrames) -> None:
    assert np.array_equal(posed.indices, truth.indices)
    assert np.allclose(posed.world_from_camera, truth.world_from_camera, atol=1e-6)
    assert posed.camera.fx == pytest.approx(truth.camera.fx, rel=1e-9)
    assert posed.reprojection_error_px < 0.5
    assert len(posed.points) > 200
    # Held-out frames are not in the file: they are located against the triangulated points.
    assert len(posed.held_out_images) == len(truth.held_out_images)
    assert np.allclose(
        posed.held_out_world_from_camera[:, :3, 3], truth.held_out_world_from_camera[:, :3, 3], atol=0.01
    )


@pytest.mark.parametrize("size_factor", [1, 4])
def test_colmap_model_round_trip(small_capture, tmp_path, size_factor):
    write_colmap_model(tmp_path / "sparse", small_capture.posed, size_factor)
    config = PosesConfig(import_path=str(tmp_path / "sparse"))
    posed = estimate_poses(small_capture.frame_set(), config, work_dir=tmp_path / "work")
    check_against_truth(posed, small_capture.posed)


def test_transforms_json_round_trip(small_capture, tmp_path, capfd):
    write_transforms(tmp_path / "transforms.json", small_capture.posed)
    config = PosesConfig(import_path=str(tmp_path / "transforms.json"))
    posed = estimate_poses(small_capture.frame_set(), config, work_dir=tmp_path / "work")
    check_against_truth(posed, small_capture.posed)
    assert capfd.readouterr().err == ""


def test_poses_of_another_video_are_refused(small_capture, tmp_path):
    write_transforms(tmp_path / "transforms.json", small_capture.posed)
    data = json.loads((tmp_path / "transforms.json").read_text())
    matrices = [frame["transform_matrix"] for frame in data["frames"]]
    order = np.random.default_rng(0).permutation(len(matrices))
    for frame, other in zip(data["frames"], order):
        frame["transform_matrix"] = matrices[other]
    (tmp_path / "transforms.json").write_text(json.dumps(data))
    config = PosesConfig(import_path=str(tmp_path / "transforms.json"))
    with pytest.raises(UsageError, match="do not fit"):
        estimate_poses(small_capture.frame_set(), config, work_dir=tmp_path / "work")


@pytest.mark.parametrize("content", ["", "[]", "{}", '{"frames": [{"file_path": "a"}]}', '{"frames": 3}'])
def test_malformed_transforms_are_refused(small_capture, tmp_path, content):
    (tmp_path / "transforms.json").write_text(content)
    config = PosesConfig(import_path=str(tmp_path / "transforms.json"))
    with pytest.raises(UsageError, match=r"transforms\.json"):
        estimate_poses(small_capture.frame_set(), config, work_dir=tmp_path / "work")


def test_folder_without_a_model_is_refused(small_capture, tmp_path):
    config = PosesConfig(import_path=str(tmp_path))
    with pytest.raises(UsageError, match="COLMAP"):
        estimate_poses(small_capture.frame_set(), config, work_dir=tmp_path / "work")
