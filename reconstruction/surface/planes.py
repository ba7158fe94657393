"""Detect the planes of a surface: floor, walls, ceiling, and support planes."""

import numpy as np

from reconstruction.core.mesh_graph import MeshGraph
from reconstruction.core.types import Plane, Surface, SurfacePlane
from reconstruction.surface.base_planes import base_outline, base_owner, behind_base, fit_base
from reconstruction.surface.config import SurfaceConfig
from reconstruction.surface.support_planes import find_support_planes


def find_planes(
    surface: Surface, config: SurfaceConfig, centers: np.ndarray | None = None
) -> tuple[SurfacePlane, ...]:
    """Detect the observed floor, walls and ceiling, then support planes by ascending height.

    Args:
        surface: in world space, floor at z = 0; its field `planes` is ignored.
        config: thresholds.
        centers: float (k, 3) of the cameras, if known; walls with openings and noise behind them are found by them.
    """
    graph = MeshGraph.from_surface(surface)
    base = fit_base(graph, config, centers)
    out = [
        SurfacePlane(
            plane.label,
            Plane(plane.plane, base_outline(graph.points[plane.members], plane.plane)),
            float(graph.areas[plane.members].sum()),
            plane.band_m,
            np.flatnonzero(plane.members).astype(np.int32),
        )
        for plane in base
    ]
    free = np.flatnonzero((base_owner(base, len(graph.points)) == 0) & ~behind_base(graph, base))
    floor = next((plane for plane in base if plane.label == "floor"), None)
    return (*out, *find_support_planes(graph, free, floor, surface.space, config.min_support_area_m2))
