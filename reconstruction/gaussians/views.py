"""Render a view of Gaussians with a rasterizer chosen by name."""

import numpy as np

from reconstruction.core.types import Camera
from reconstruction.gaussians.backends import load_backend
from reconstruction.gaussians.model import Gaussians
from reconstruction.gaussians.rasterizer import RasterSettings
from reconstruction.gaussians.rendering import Render


def render_gaussians(
    gaussians: Gaussians,
    camera: Camera,
    world_from_camera: np.ndarray,
    *,
    settings: RasterSettings | None = None,
    pixel_weights: np.ndarray | None = None,
    backend: str = "cpu",
) -> Render:
    """Render a view.

    Args:
        gaussians: of `fit_gaussians`, or read from a .ply.
        camera: pinhole camera.
        world_from_camera: (4, 4) rigid, in the space of the Gaussians.
        settings: cut-offs.
        pixel_weights: (h, w) weights of the pixels in `Render.contribution`: ones for contributions to the view, a mask
            for contributions to an object.
        backend: as `GaussiansConfig.backend`.
    """
    return load_backend(backend).render(
        gaussians.packed(), camera, world_from_camera, settings or RasterSettings(), pixel_weights
    )
