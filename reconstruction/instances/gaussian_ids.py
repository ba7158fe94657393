"""Instance ids of Gaussians, from the nearest labeled surface vertex."""

import numpy as np
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]

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
