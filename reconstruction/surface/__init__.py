"""Stage 5: depth maps -> one fused surface, and what is known of free space."""

from reconstruction.surface.config import SURFACE_PRESETS, SurfaceConfig
from reconstruction.surface.fuse import fuse_surface
from reconstruction.surface.local import LocalVolume, fuse_box, prepare_fusion

VERSION = 1

__all__ = [
    "SURFACE_PRESETS",
    "VERSION",
    "LocalVolume",
    "SurfaceConfig",
    "fuse_box",
    "fuse_surface",
    "prepare_fusion",
]
