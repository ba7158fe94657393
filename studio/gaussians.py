"""Gaussians of a bundle as means and covariances."""

from dataclasses import dataclass

import numpy as np

from registry import SceneBundle
from registry.geometry import matrix_from_quat
from registry.plyfiles import read_vertices

_SH_C0 = 0.28209479177387814  # constant spherical harmonic: color = 0.5 + C0 * coefficient
_FLAT = 1e-3  # thickness of a 2D Gaussian as a share of its smaller axis; viewers of 3D Gaussians need one


@dataclass(frozen=True)
class GaussianCloud:
    """Gaussians in world space, metres."""

    centers: np.ndarray  # float32 (n, 3)
    covariances: np.ndarray  # float32 (n, 3, 3)
    colors: np.ndarray  # float32 (n, 3) sRGB, 0 to 1
    opacities: np.ndarray  # float32 (n,)
    owners: np.ndarray  # int (n,) id of object or base entity; 0: none


def read_gaussians(bundle: SceneBundle) -> GaussianCloud | None:
    """Read the 2D Gaussians of a bundle; None: it has none.

    Raises:
        BundleError: the file is damaged.
    """
    entry = bundle.scene.get("gaussians")
    if entry is None:
        return None
    found = read_vertices(bundle.resolve(entry["file"]))

    def take(*names: str) -> np.ndarray:
        return np.stack([np.asarray(found[name], np.float64) for name in names], axis=1)

    axes = matrix_from_quat(take("rot_0", "rot_1", "rot_2", "rot_3"))
    scales = np.exp(take("scale_0", "scale_1"))
    scales = np.column_stack([scales, _FLAT * scales.min(axis=1)])
    stretched = axes * scales[:, None, :]
    owners = found.get("instance_id", np.zeros(len(scales)))
    return GaussianCloud(
        take("x", "y", "z").astype(np.float32),
        (stretched @ stretched.transpose(0, 2, 1)).astype(np.float32),
        np.clip(0.5 + _SH_C0 * take("f_dc_0", "f_dc_1", "f_dc_2"), 0, 1).astype(np.float32),
        (1 / (1 + np.exp(-take("opacity")[:, 0]))).astype(np.float32),
        np.asarray(owners).astype(np.int64),
    )
