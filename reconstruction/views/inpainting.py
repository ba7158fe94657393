"""Inpainting of pixels that no Gaussian covers: the interface, and two methods of OpenCV."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from reconstruction.core.plugins import load_plugin
from reconstruction.views.config import AvoConfig


class Inpainter(Protocol):
    """Fills holes in a picture."""

    @property
    def name(self) -> str:
        """Value of `AvoConfig.inpainting`."""
        ...

    def inpaint(self, picture: np.ndarray, holes: np.ndarray) -> np.ndarray:
        """Return the picture, uint8 (h, w, 3) RGB, with the pixels of `holes`, bool (h, w), filled."""
        ...


@dataclass(frozen=True)
class OpenCvInpainter:
    """Diffusion from the border of holes (Telea 2004, or Navier-Stokes): good for thin holes, blurry in wide ones."""

    name: str
    radius_px: float = 3.0

    def inpaint(self, picture: np.ndarray, holes: np.ndarray) -> np.ndarray:
        """See `Inpainter.inpaint`; a picture without any known pixel is returned unchanged."""
        import cv2

        if not holes.any() or holes.all():
            return picture.copy()
        method = cv2.INPAINT_TELEA if self.name == "telea" else cv2.INPAINT_NS
        filled = cv2.inpaint(np.ascontiguousarray(picture), holes.astype(np.uint8), self.radius_px, method)
        return np.where(holes[..., None], filled, picture)


INPAINTERS: dict[str, Inpainter] = {name: OpenCvInpainter(name) for name in ("telea", "navier-stokes")}


def load_inpainter(name: str) -> Inpainter:
    """Return an inpainter by name.

    Raises:
        UsageError: there is no such inpainter.
    """
    return INPAINTERS[name] if name in INPAINTERS else load_plugin("avo.inpainting", name, AvoConfig)()
