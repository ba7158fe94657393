"""Layers of the page: what can be shown, each sent to the browser when it is first switched on."""

from studio.layers.appearance import COLLISION, COVERAGE, GAUSSIANS, TEXTURES, Appearance
from studio.layers.base import Layer
from studio.layers.cameras import CameraLayer
from studio.layers.free_space import FreeSpaceLayer
from studio.layers.names import NameLayer
from studio.layers.relations import RelationLayer
from studio.layers.ruler import RulerLayer

# In the order of their checkboxes.
OVERLAYS: tuple[type[Layer], ...] = (NameLayer, CameraLayer, RelationLayer, FreeSpaceLayer, RulerLayer)

__all__ = [
    "COLLISION", "COVERAGE", "GAUSSIANS", "OVERLAYS", "TEXTURES", "Appearance", "CameraLayer", "FreeSpaceLayer",
    "Layer", "NameLayer", "RelationLayer", "RulerLayer",
]  # fmt: skip
