"""How far a solid is from its convex hull."""

import numpy as np
from scipy.spatial import cKDTree

from reconstruction.assets.config import AssetsConfig
from reconstruction.assets.solid import Solid, hull_solid

_PROBES = 1500


def nearly_convex(solid: Solid, config: AssetsConfig) -> Solid | None:
    """Return the convex hull where the surface nowhere lies deeper inside it than reconstruction noise."""
    hull = hull_solid(solid.vertices)
    if solid.volume > config.convex_enough * hull.volume:
        return hull
    if solid.volume < 0.6 * hull.volume:
        return None
    allowed = np.clip(config.dent_share * float(np.median(solid.extents)), 0.003, config.dent_limit_m)
    return hull if dent(solid, hull, config.seed) < allowed else None


def waste(solid: Solid) -> float:
    """Return how much empty space a solid's convex hull takes, cubic metres."""
    return max(0.0, hull_solid(solid.vertices).volume - solid.volume)


def dent(solid: Solid, hull: Solid, seed: int) -> float:
    """Return how deep in its hull a solid's surface lies, metres: the 95th percentile over the hull.

    Over an opening that is its half width, over noise it is the noise.
    """
    corner = hull.vertices[hull.faces]
    area = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)
    rng = np.random.default_rng(seed)
    chosen = rng.choice(len(area), _PROBES, p=area / area.sum())
    weight = rng.dirichlet((1.0, 1.0, 1.0), _PROBES)
    probes = np.einsum("nk,nkc->nc", weight, corner[chosen])
    surface = np.concatenate([solid.vertices, solid.vertices[solid.faces].mean(axis=1)])
    gap, _ = cKDTree(surface).query(probes)
    return float(np.percentile(gap, 95))
