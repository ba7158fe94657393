"""Interface of differentiable rasterizers of Gaussians."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from reconstruction.core.types import Camera
from reconstruction.gaussians.losses import FrameTarget, LossWeights
from reconstruction.gaussians.rasterizer import RasterSettings
from reconstruction.gaussians.rendering import Render


@dataclass(frozen=True)
class StepResult:
    """Loss of one frame and its gradients; arrays are valid until the next step."""

    terms: dict[str, float]  # unweighted terms by name
    total: float
    parameters: np.ndarray  # (n, 13) gradient
    pose: np.ndarray  # (6,) gradient by xi of world_from_camera exp(xi): translation, rotation in camera axes
    gain: np.ndarray  # (3,) gradient by the exposure gain
    bias: np.ndarray  # (3,) gradient by the exposure bias
    rows: np.ndarray  # int (k,) Gaussians in view
    depths: np.ndarray  # (k,) z-depth of their centers
    contribution: np.ndarray  # (n,) sum over pixels of alpha T
    error: np.ndarray  # (n,) sum over pixels of alpha T times color error


class Backend(Protocol):
    """Renders packed Gaussians (n, 13) and differentiates the training loss."""

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
        ...

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
        """Evaluate the loss of one frame (see `losses`) and its gradients."""
        ...
