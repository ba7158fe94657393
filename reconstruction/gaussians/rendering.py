"""The rendered view of Gaussians, common to all rasterizers."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Render:
    """One rendered view; all arrays are float32, depth is in the units of the scene."""

    color: np.ndarray  # (h, w, 3) RGB over black, without exposure, not clipped
    depth: np.ndarray  # (h, w) expected z-depth sum(w z) / sum(w), 0 where nothing is drawn
    median_depth: np.ndarray  # (h, w) z-depth at which transmittance falls to 0.5, 0 if it does not
    normal: np.ndarray  # (h, w, 3) sum of w n, camera frame, towards the camera; length <= opacity
    opacity: np.ndarray  # (h, w) in [0, 1]
    distortion: np.ndarray  # (h, w) spread of the splats along the ray
    contribution: np.ndarray | None  # (n,) sum over pixels of weight alpha T; None without pixel weights

    def uint8(self) -> np.ndarray:
        """Return the color, uint8 (h, w, 3)."""
        return np.round(np.clip(self.color, 0, 1) * 255).astype(np.uint8)
