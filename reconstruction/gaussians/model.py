"""Gaussians as an artifact, and their packed form (n, 13) for kernels."""

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from reconstruction.core.checked_arrays import CheckedArrays
from registry.geometry import matrix_from_quat, quat_from_matrix, split_similarity

SH_C0 = 0.28209479177387814  # the constant spherical harmonic: color = 0.5 + SH_C0 * coefficient
N_PARAMETERS = 13  # mean 3, quaternion 4, log scales 2, opacity logit 1, color 3


@dataclass(frozen=True)
class Gaussians(CheckedArrays):
    """2D Gaussians (oriented disks) in the space of the posed frames that they were fitted to.

    Colors are view-independent (spherical harmonics of degree 0), in sRGB values, not linear light. Keyframe k is
    modeled as `exposure_gain[k] * rendered + exposure_bias[k]`, seen by `world_from_camera[k]`.
    """

    means: Annotated[np.ndarray, "float32 n 3"]
    quaternions: Annotated[np.ndarray, "float32 n 4"]  # wxyz, unit; matrix columns are t_u, t_v, normal
    log_scales: Annotated[np.ndarray, "float32 n 2"]  # ln of standard deviations along t_u, t_v
    opacity_logits: Annotated[np.ndarray, "float32 n"]
    colors: Annotated[np.ndarray, "float32 n 3"]  # SH coefficients c of degree 0: rgb = 0.5 + 0.2821 c
    exposure_gain: Annotated[np.ndarray, "float32 k 3"]  # per keyframe and color channel
    exposure_bias: Annotated[np.ndarray, "float32 k 3"]
    world_from_camera: Annotated[np.ndarray, "float64 k 4 4"]  # rigid; as optimized, if `optimize_poses`

    def __len__(self) -> int:
        """Return the number of Gaussians."""
        return len(self.means)

    @property
    def rgb(self) -> np.ndarray:
        """Return RGB colors (n, 3), at least 0; the fit may exceed 1."""
        return np.maximum(0.5 + SH_C0 * self.colors, 0.0)

    @property
    def opacities(self) -> np.ndarray:
        """Return opacities (n,) in (0, 1)."""
        return 1.0 / (1.0 + np.exp(-self.opacity_logits))

    def packed(self) -> np.ndarray:
        """Return the parameters as one float32 array (n, 13)."""
        columns = [self.means, self.quaternions, self.log_scales, self.opacity_logits[:, None], self.colors]
        return np.ascontiguousarray(np.concatenate(columns, axis=1), np.float32)


def from_packed(
    parameters: np.ndarray,
    exposure_gain: np.ndarray | None = None,
    exposure_bias: np.ndarray | None = None,
    world_from_camera: np.ndarray | None = None,
) -> Gaussians:
    """Unpack parameters (n, 13); quaternions are normalized to w >= 0. Without cameras k is 0."""
    p = np.asarray(parameters, np.float32)
    quaternions = p[:, 3:7] / np.maximum(np.linalg.norm(p[:, 3:7], axis=1, keepdims=True), 1e-12)
    quaternions = np.where(quaternions[:, :1] < 0, -quaternions, quaternions)
    frames = 0 if world_from_camera is None else len(world_from_camera)
    return Gaussians(
        means=p[:, :3].copy(),
        quaternions=quaternions.astype(np.float32),
        log_scales=p[:, 7:9].copy(),
        opacity_logits=p[:, 9].copy(),
        colors=p[:, 10:13].copy(),
        exposure_gain=np.ones((frames, 3), np.float32) if exposure_gain is None else exposure_gain,
        exposure_bias=np.zeros((frames, 3), np.float32) if exposure_bias is None else exposure_bias,
        world_from_camera=np.zeros((0, 4, 4)) if world_from_camera is None else world_from_camera,
    )


def moved(gaussians: Gaussians, b_from_a: np.ndarray) -> Gaussians:
    """Return the Gaussians and their cameras in space b; b_from_a (4, 4) is a similarity."""
    scale, rotation, translation = split_similarity(b_from_a)
    axes = rotation @ matrix_from_quat(gaussians.quaternions)
    poses = np.array(gaussians.world_from_camera, np.float64)
    poses[:, :3, :3] = rotation @ poses[:, :3, :3]
    poses[:, :3, 3] = scale * poses[:, :3, 3] @ rotation.T + translation
    return replace(
        gaussians,
        means=(scale * gaussians.means @ rotation.T + translation).astype(np.float32),
        quaternions=quat_from_matrix(axes).astype(np.float32),
        log_scales=(gaussians.log_scales + np.log(scale)).astype(np.float32),
        world_from_camera=poses,
    )
