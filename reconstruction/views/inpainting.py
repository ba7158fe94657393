"""Filling what no Gaussian covers: the seam for inpainters, and OpenCV's two."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from registry.errors import UsageError


class Inpainter(Protocol):
    """Fills holes in a picture."""

    name: str

    def inpaint(self, picture: np.ndarray, holes: np.ndarray) -> np.ndarray:
        """Return the picture, uint8 (h, w, 3) RGB, with what lies under `holes`, bool (h, w), made up.

        Pixels outside the holes stay as they are.
        """


@dataclass(frozen=True)
class OpenCvInpainter:
    """Diffusion from the border of the holes: good for thin ones, a blur in wide ones."""

    name: str
    radius_px: float = 3.0

    def inpaint(self, picture: np.ndarray, holes: np.ndarray) -> np.ndarray:
        """See `Inpainter.inpaint`; a picture that is nothing but hole stays as it is."""
        import cv2

        if not holes.any() or holes.all():
            return picture.copy()
        method = cv2.INPAINT_TELEA if self.name == "telea" else cv2.INPAINT_NS
        filled = cv2.inpaint(np.ascontiguousarray(picture), holes.astype(np.uint8), self.radius_px, method)
        return np.where(holes[..., None], filled, picture)


INPAINTERS: dict[str, Inpainter] = {name: OpenCvInpainter(name) for name in ("telea", "navier-stokes")}


def load_inpainter(name: str) -> Inpainter:
    """Return an inpainter by name; to add one, put it into INPAINTERS.

    Raises:
        UsageError: there is no such inpainter.
    """
    if name not in INPAINTERS:
        raise UsageError(f"views: no inpainter {name!r}; there are {', '.join(INPAINTERS)}")
    return INPAINTERS[name]
