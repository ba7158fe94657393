"""Write and read Gaussians as `.ply` in the 3DGS format of existing viewers.

The third scale of a disk is written as a thousandth of its smaller one. Any 3DGS file can be read: the axis with the
smallest scale becomes the normal, and higher spherical harmonics are dropped.
"""

from pathlib import Path

import numpy as np
from plyfile import PlyData, PlyElement

from reconstruction.gaussians.model import Gaussians, from_packed
from registry.errors import BundleError
from registry.geometry import matrix_from_quat, quat_from_matrix
from registry.plyfiles import read_vertices

_THICKNESS = 1e-3  # third scale relative to the smaller of the others
_REQUIRED = (
    "x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "rot_0", "rot_1", "rot_2", "rot_3",
)  # fmt: skip
_WRITTEN = (
    "x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2",
    "rot_0", "rot_1", "rot_2", "rot_3",
)  # fmt: skip


def write_ply(gaussians: Gaussians, path: Path, instances: np.ndarray | None = None) -> None:
    """Write the Gaussians, without exposures and cameras, as binary little-endian PLY.

    Args:
        gaussians: what to write.
        path: the file.
        instances: int (n,) ids of the Gaussians, written as the property `instance_id`; None: not written.
    """
    g = gaussians
    ids = [] if instances is None else [("instance_id", "<i4")]
    columns = np.empty(len(g), [(name, "<f4") for name in _WRITTEN] + ids)
    normals = matrix_from_quat(g.quaternions)[:, :, 2]
    for c in range(3):
        columns["xyz"[c]], columns[f"n{'xyz'[c]}"] = g.means[:, c], normals[:, c]
        columns[f"f_dc_{c}"] = g.colors[:, c]
    columns["opacity"] = g.opacity_logits
    columns["scale_0"], columns["scale_1"] = g.log_scales[:, 0], g.log_scales[:, 1]
    columns["scale_2"] = g.log_scales.min(axis=1) + np.log(_THICKNESS)
    for c in range(4):
        columns[f"rot_{c}"] = g.quaternions[:, c]
    if instances is not None:
        columns["instance_id"] = instances
    PlyData([PlyElement.describe(columns, "vertex")], byte_order="<").write(path)


def read_ply(path: Path) -> Gaussians:
    """Read a 3DGS .ply, binary or ASCII.

    Raises:
        BundleError: it is not a PLY of Gaussians, or it is truncated.
    """
    columns = read_vertices(path)
    missing = [name for name in _REQUIRED if name not in columns]
    if missing:
        raise BundleError(f"{path}: not a 3DGS file: it has no property {', '.join(missing)}")

    def take(*wanted: str) -> np.ndarray:
        return np.stack([np.asarray(columns[name], np.float64) for name in wanted], axis=1)

    quaternions, scales = take("rot_0", "rot_1", "rot_2", "rot_3"), take("scale_0", "scale_1")
    if "scale_2" in columns and len(quaternions):
        quaternions, scales = _normal_last(quaternions, take("scale_0", "scale_1", "scale_2"))
    colors = take("f_dc_0", "f_dc_1", "f_dc_2")
    parts = [take("x", "y", "z"), quaternions, scales[:, :2], take("opacity"), colors]
    return from_packed(np.concatenate(parts, axis=1))


def _normal_last(quaternions: np.ndarray, scales: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Permute the axes of 3D Gaussians cyclically, such that the third is the thinnest."""
    thinnest = np.argmin(scales, axis=1)
    order = (thinnest[:, None] + np.array([1, 2, 0])) % 3  # cyclic, to keep the axes right-handed
    turned = thinnest != 2
    if turned.any():
        axes = np.take_along_axis(matrix_from_quat(quaternions[turned]), order[turned][:, None, :], axis=2)
        quaternions = quaternions.copy()
        quaternions[turned] = quat_from_matrix(axes)
    return quaternions, np.take_along_axis(scales, order, axis=1)
