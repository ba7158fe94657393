"""Deviation of a solid from its convex hull."""

import numpy as np
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]

from reconstruction.assets.config import AssetsConfig
from reconstruction.assets.solid import Solid, hull_solid, surface_samples
from reconstruction.core.types import ConvexPart

_PROBES = 1500


def part_of(solid: Solid) -> ConvexPart:
    """Convert a convex solid to the array types of `ConvexPart`."""
    return ConvexPart(solid.vertices.astype(np.float32), solid.faces.astype(np.int32))


def nearly_convex(solid: Solid, config: AssetsConfig) -> Solid | None:
    """Return a solid's convex hull if its dents are within reconstruction noise; else None."""
    hull = hull_solid(solid.vertices)
    if solid.volume > config.convex_enough * hull.volume:
        return hull
    if solid.volume < 0.6 * hull.volume:
        return None
    allowed = np.clip(config.dent_share * float(np.median(solid.extents)), 0.003, config.dent_limit_m)
    return hull if dent(solid, hull, config.seed) < allowed else None


def waste(solid: Solid) -> float:
    """Return the empty volume in a solid's convex hull, cubic metres."""
    return max(0.0, hull_solid(solid.vertices).volume - solid.volume)


def dent(solid: Solid, hull: Solid, seed: int) -> float:
    """Return the 95th percentile of the distance from the convex hull to the solid's vertices and face centers, metres.

    Over an opening that is its half width, over noise it is the noise.
    """
    probes = surface_samples(hull, _PROBES, np.random.default_rng(seed))
    surface = np.concatenate([solid.vertices, solid.vertices[solid.faces].mean(axis=1)])
    gap, _ = cKDTree(surface).query(probes)
    return float(np.percentile(gap, 95))
