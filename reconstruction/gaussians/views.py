"""Gaussians, a camera and its pose in, a rendered view out, by the rasterizer that is asked for."""

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
        gaussians: Of `fit_gaussians`, or read from a .ply.
        camera: Pinhole camera.
        world_from_camera: (4, 4) rigid, in the space of the Gaussians.
        settings: Cut-offs; `near` counts in the units of the scene.
        pixel_weights: (h, w) to also sum alpha T of every Gaussian over the pixels with these weights: ones for its
            contribution to the view, a mask of one object's pixels for its share in that object.
        backend: "cpu" or "gsplat".
    """
    return load_backend(backend).render(
        gaussians.packed(), camera, world_from_camera, settings or RasterSettings(), pixel_weights
    )
