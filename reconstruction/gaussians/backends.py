"""The seam between training and rasterizers: `cpu` (Numba, built in) and `gsplat` (CUDA)."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from reconstruction.gaussians.losses import FrameTarget, LossWeights, image_loss
from reconstruction.gaussians.rasterizer import RasterSettings, rasterize, rasterize_backward
from reconstruction.gaussians.rendering import Render
from reconstruction.gaussians.scratch import Scratch
from reconstruction.types import Camera
from registry.errors import UsageError


@dataclass(frozen=True)
class StepResult:
    """Loss of one frame and its derivatives by everything that is optimized; valid until the next step."""

    terms: dict[str, float]  # unweighted
    total: float
    parameters: np.ndarray  # (n, 13)
    pose: np.ndarray  # (6,) of world_from_camera exp(xi): translation, rotation in camera axes
    gain: np.ndarray  # (3,)
    bias: np.ndarray  # (3,)
    rows: np.ndarray  # int (k,) Gaussians in view
    depths: np.ndarray  # (k,) their depths
    contribution: np.ndarray  # (n,) sum over pixels of alpha T
    error: np.ndarray  # (n,) the same, weighted with the pixels' color error


class Backend(Protocol):
    """Renders packed Gaussians (n, 13), and differentiates the training loss."""

    name: str

    def render(
        self,
        parameters: np.ndarray,
        camera: Camera,
        world_from_camera: np.ndarray,
        settings: RasterSettings,
        pixel_weights: np.ndarray | None = None,
    ) -> Render:
        """Render a view, see `render_gaussians`."""

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
        """Evaluate the loss of one frame (see `losses`) and its derivatives."""


class CpuBackend:
    """The Numba tile rasterizer."""

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
    raise UsageError(f"gaussians: no backend {name!r}; there are cpu and gsplat")
