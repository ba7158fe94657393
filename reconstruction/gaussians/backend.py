"""Protocol of differentiable rasterizers: Gaussians and a camera in, a rendered view or a loss with derivatives out."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from reconstruction.core.types import Camera
from reconstruction.gaussians.losses import FrameTarget, LossWeights
from reconstruction.gaussians.rasterizer import RasterSettings
from reconstruction.gaussians.rendering import Render


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
