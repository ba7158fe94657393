"""Instance ids of Gaussians, from the nearest labeled surface vertex."""

from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]

from registry.errors import BundleError

PROPERTY = "instance_id"
_REACH_M = 0.05  # largest distance to a vertex: the surface is sampled up to this sparsely


def gaussian_instances(means: np.ndarray, vertices: np.ndarray, vertex_instance: np.ndarray) -> np.ndarray:
    """Return the instance id int32 (g,) of each Gaussian, 0 where no labeled vertex is within 5 cm.

    Args:
        means: float (g, 3) centers in world space, metres.
        vertices: float (v, 3) of the fused surface in world space.
        vertex_instance: int (v,) ids of the vertices, 0 = none.
    """
    labeled = np.flatnonzero(np.asarray(vertex_instance) > 0)
    if len(labeled) == 0 or len(means) == 0:
        return np.zeros(len(means), np.int32)
    tree = cKDTree(np.asarray(vertices, np.float64)[labeled])
    distance, nearest = tree.query(np.asarray(means, np.float64), distance_upper_bound=_REACH_M)
    found = np.isfinite(distance)
    out = np.zeros(len(means), np.int32)
    out[found] = np.asarray(vertex_instance)[labeled[nearest[found]]]
    return out


def add_instances_to_ply(path: Path, instances: np.ndarray) -> None:
    """Append the integer property `instance_id` to each Gaussian of a binary little-endian PLY of floats, in place.

    Raises:
        BundleError: the file holds another number of Gaussians, or properties that are not floats.
    """
    header, _, data = path.read_bytes().partition(b"end_header\n")
    floats = header.count(b"property float ")
    rows = np.frombuffer(data, f"({floats},)<f4")
    if floats != header.count(b"property ") or len(rows) != len(instances):
        raise BundleError(f"{path}: expected {len(instances)} Gaussians with nothing but float properties")
    out = np.empty(len(rows), [("floats", "<f4", (floats,)), (PROPERTY, "<i4")])
    out["floats"], out[PROPERTY] = rows, instances
    with path.open("wb") as file:
        file.write(header + f"property int {PROPERTY}\nend_header\n".encode("ascii"))
        file.write(out.tobytes())
