"""What a view of the Gaussians looks like, whichever rasterizer drew it."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Render:
    """One rendered view; all arrays float32, normals in camera space, depth in the units of the scene."""

    color: np.ndarray  # (h, w, 3) over black, without exposure, not clipped
    depth: np.ndarray  # (h, w) expected z-depth sum(w z) / sum(w), 0 where nothing is drawn
    median_depth: np.ndarray  # (h, w) z-depth at which half of the light is stopped, 0 where less is
    normal: np.ndarray  # (h, w, 3) sum of w n, towards the camera, length at most the opacity
    opacity: np.ndarray  # (h, w) accumulated, in [0, 1]
    distortion: np.ndarray  # (h, w) spread of the splats along the ray
    contribution: (
        np.ndarray | None
    )  # (n,) sum over pixels of weight alpha T of every Gaussian, where asked for

    def uint8(self) -> np.ndarray:
        """Return the color as an image."""
        return np.round(np.clip(self.color, 0, 1) * 255).astype(np.uint8)
