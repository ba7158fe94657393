"""Rough predictions of cameras end as accurate as cameras that were found from matches alone."""

import importlib.util

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from reconstruction.core.types import PosedFrames
from reconstruction.poses import PosesConfig, estimate_poses
from reconstruction.poses.backends import PredictedPoses, load_pose_backend
from registry.errors import EnvironmentMissing
from registry.geometry import transform_points, umeyama

pytestmark = pytest.mark.stage


class RoughTruth:
    """Predicts true cameras, 2.5 degrees, 4 cm and 4 % of the focal length off."""

    name = "rough"

    def __init__(self, truth: PosedFrames) -> None:
        self.truth = truth

    def predict(self, images: np.ndarray) -> PredictedPoses:
        rng = np.random.default_rng(4)
        poses = self.truth.world_from_camera.copy()
        for pose in poses:
            pose[:3, :3] @= Rotation.from_rotvec(
                np.radians(2.5) * rng.standard_normal(3) / np.sqrt(3)
            ).as_matrix()
            pose[:3, 3] += 0.04 * rng.standard_normal(3) / np.sqrt(3)
        return PredictedPoses(poses, 1.04 * self.truth.camera.fx)


def ate_m(posed: PosedFrames, truth: PosedFrames) -> float:
    true = truth.world_from_camera[np.searchsorted(truth.indices, posed.indices), :3, 3]
    ours = posed.world_from_camera[:, :3, 3]
    return float(np.sqrt(((transform_points(umeyama(ours, true), ours) - true) ** 2).sum(1).mean()))


def test_rough_predictions_become_accurate(small_capture, tmp_path):
    frames, truth = small_capture.frame_set(), small_capture.posed
    found = estimate_poses(frames, PosesConfig(), work_dir=tmp_path / "a")
    rough = estimate_poses(frames, PosesConfig(), work_dir=tmp_path / "b", backend=RoughTruth(truth))
    assert len(rough.images) == len(truth.images)
    assert not rough.metric
    assert ate_m(rough, truth) < 2 * max(ate_m(found, truth), 0.001)


@pytest.mark.skipif(importlib.util.find_spec("vggt") is not None, reason="vggt is installed here")
def test_a_missing_backend_says_how_to_get_it():
    with pytest.raises(EnvironmentMissing, match="pip install"):
        load_pose_backend("vggt")
