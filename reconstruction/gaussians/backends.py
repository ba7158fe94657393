"""Load rasterizers by name: `cpu` (Numba, built in), `gsplat` (CUDA), or a plugin."""

import numpy as np

from reconstruction.core.plugins import load_plugin
from reconstruction.core.types import Camera
from reconstruction.gaussians.backend import Backend, StepResult
from reconstruction.gaussians.config import GaussiansConfig
from reconstruction.gaussians.losses import FrameTarget, LossWeights, image_loss
from reconstruction.gaussians.rasterizer import RasterSettings, rasterize, rasterize_backward
from reconstruction.gaussians.rendering import Render
from reconstruction.gaussians.scratch import Scratch


class CpuBackend:
    """The tile rasterizer in Numba."""

    name = "cpu"

    def __init__(self) -> None:
        self._scratch = Scratch()

    def render(
        self,
        parameters: np.ndarray,
        camera: Camera,
        world_from_camera: np.ndarray,
        settings: RasterSettings,
        pixel_weights: np.ndarray | None = None,
    ) -> Render:
        """See `Backend.render`."""
        image = rasterize(parameters, camera, world_from_camera, settings, pixel_weights)
        f = image.features
        depth = np.where(f[..., 7] > 1e-6, f[..., 3] / np.maximum(f[..., 7], 1e-6), 0)
        return Render(f[..., :3], depth, f[..., 12], f[..., 4:7], f[..., 7], f[..., 8], image.contributions)

    def step(
        self,
        parameters: np.ndarray,
        world_from_camera: np.ndarray,
        target: FrameTarget,
        gain: np.ndarray,
        bias: np.ndarray,
        weights: LossWeights,
        settings: RasterSettings,
    ) -> StepResult:
        """See `Backend.step`."""
        image = rasterize(parameters, target.camera, world_from_camera, settings, scratch=self._scratch)
        loss = image_loss(image.features, target, gain, bias, weights, self._scratch)
        gradients = rasterize_backward(image, loss.image_gradients, loss.error, self._scratch)
        return StepResult(
            loss.terms, loss.total, gradients.parameters, gradients.pose, loss.gain, loss.bias, image.rows,
            image.splats[:, 2], gradients.contributions, gradients.errors,
        )  # fmt: skip


def load_backend(name: str) -> Backend:
    """Return a rasterizer by name.

    Raises:
        UsageError: there is no such backend.
        EnvironmentMissing: gsplat or CUDA is missing.
    """
    if name == "cpu":
        return CpuBackend()
    if name == "gsplat":
        from reconstruction.gaussians.gsplat_backend import GsplatBackend

        return GsplatBackend()
    return load_plugin("gaussians.backend", name, GaussiansConfig)()
