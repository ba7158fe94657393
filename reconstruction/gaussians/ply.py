"""Write and read Gaussians as `.ply` in the 3DGS format of existing viewers.

The third scale of a disk is written as a thousandth of its smaller one. Any 3DGS file can be read: the axis with the
smallest scale becomes the normal, and higher spherical harmonics are dropped.
"""

from pathlib import Path

import numpy as np

from reconstruction.gaussians.model import Gaussians, from_packed
from registry.errors import BundleError
from registry.geometry import matrix_from_quat, quat_from_matrix

_THICKNESS = 1e-3  # third scale relative to the smaller of the others
_REQUIRED = (
    "x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "rot_0", "rot_1", "rot_2", "rot_3",
)  # fmt: skip
_WRITTEN = (
    "x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2",
    "rot_0", "rot_1", "rot_2", "rot_3",
)  # fmt: skip
_TYPES = {
    "char": "i1", "uchar": "u1", "short": "<i2", "ushort": "<u2", "int": "<i4", "uint": "<u4", "float": "<f4",
    "double": "<f8", "int8": "i1", "uint8": "u1", "int16": "<i2", "uint16": "<u2", "int32": "<i4", "uint32": "<u4",
    "float32": "<f4", "float64": "<f8",
}  # fmt: skip


def write_ply(gaussians: Gaussians, path: Path) -> None:
    """Write the Gaussians, without exposures and cameras, as binary little-endian PLY."""
    g = gaussians
    columns = np.empty(len(g), [(name, "<f4") for name in _WRITTEN])
    normals = matrix_from_quat(g.quaternions)[:, :, 2]
    for c in range(3):
        columns["xyz"[c]], columns[f"n{'xyz'[c]}"] = g.means[:, c], normals[:, c]
        columns[f"f_dc_{c}"] = g.colors[:, c]
    columns["opacity"] = g.opacity_logits
    columns["scale_0"], columns["scale_1"] = g.log_scales[:, 0], g.log_scales[:, 1]
    columns["scale_2"] = g.log_scales.min(axis=1) + np.log(_THICKNESS)
    for c in range(4):
        columns[f"rot_{c}"] = g.quaternions[:, c]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(g)}"]
    header += [f"property float {name}" for name in _WRITTEN] + ["end_header", ""]
    with Path(path).open("wb") as file:
        file.write("\n".join(header).encode("ascii"))
        file.write(columns.tobytes())


def read_ply(path: Path) -> Gaussians:
    """Read a 3DGS .ply, binary little-endian or ASCII.

    Raises:
        BundleError: it is not a PLY of Gaussians, or it is truncated.
    """
    path = Path(path)
    with path.open("rb") as file:
        count, fields, binary = _read_header(file, path)
        columns = (
            _read_binary(file, path, count, fields) if binary else _read_ascii(file, path, count, fields)
        )
    missing = [name for name in _REQUIRED if name not in columns]
    if missing:
        raise BundleError(f"{path}: not a 3DGS file: it has no property {', '.join(missing)}")

    def take(*wanted: str) -> np.ndarray:
        return np.stack([np.asarray(columns[name], np.float64) for name in wanted], axis=1)

    quaternions, scales = take("rot_0", "rot_1", "rot_2", "rot_3"), take("scale_0", "scale_1")
    if "scale_2" in columns and count:
        quaternions, scales = _normal_last(quaternions, take("scale_0", "scale_1", "scale_2"))
    colors = take("f_dc_0", "f_dc_1", "f_dc_2")
    parts = [take("x", "y", "z"), quaternions, scales[:, :2], take("opacity"), colors]
    return from_packed(np.concatenate(parts, axis=1))


def _read_binary(file, path: Path, count: int, fields: list[tuple[str, str]]) -> dict[str, np.ndarray]:
    dtype = np.dtype(fields)
    data = file.read(count * dtype.itemsize)
    if len(data) < count * dtype.itemsize:
        raise BundleError(f"{path}: truncated: {len(data)} of {count * dtype.itemsize} bytes of vertices")
    rows = np.frombuffer(data, dtype)
    return {name: rows[name] for name, _ in fields}


def _read_ascii(file, path: Path, count: int, fields: list[tuple[str, str]]) -> dict[str, np.ndarray]:
    try:
        table = np.loadtxt(file, max_rows=count, ndmin=2)
    except ValueError as error:
        raise BundleError(f"{path}: malformed ASCII vertices ({error})") from error
    if table.shape != (count, len(fields)):
        raise BundleError(f"{path}: expected {count} rows of {len(fields)} values, found {table.shape}")
    return {name: column for (name, _), column in zip(fields, table.T)}


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


def _read_header(file, path: Path) -> tuple[int, list[tuple[str, str]], bool]:
    """Read up to end_header; return the number of vertices, (name, dtype) of their properties, and if binary."""
    if file.readline().strip() != b"ply":
        raise BundleError(f"{path}: not a PLY file")
    count, fields, binary, element = -1, [], True, ""
    for _ in range(1000):
        words = file.readline().decode("ascii", "replace").split()
        if not words:
            raise BundleError(f"{path}: the PLY header does not end")
        if words[0] == "format":
            if words[1] not in ("binary_little_endian", "ascii"):
                raise BundleError(f"{path}: format {words[1]} is not supported; write binary_little_endian")
            binary = words[1] != "ascii"
        elif words[0] == "element":
            if words[1] == "vertex":
                count = int(words[2])
            elif count < 0:
                raise BundleError(f"{path}: element {words[1]} comes before the vertices")
            element = words[1]
        elif words[0] == "property" and element == "vertex":
            if words[1] not in _TYPES:
                raise BundleError(f"{path}: vertex properties of type {words[1]} are not supported")
            fields.append((words[2], _TYPES[words[1]]))
        elif words[0] == "end_header":
            break
    if count < 0:
        raise BundleError(f"{path}: no vertices")
    return count, fields, binary
