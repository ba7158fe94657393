"""Classes of pycolmap for annotations; pycolmap itself is imported inside of the functions that use it."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pycolmap import Camera as ColmapCamera
    from pycolmap import Reconstruction, TwoViewGeometry
else:
    ColmapCamera = Reconstruction = TwoViewGeometry = object

__all__ = ["ColmapCamera", "Reconstruction", "TwoViewGeometry"]
