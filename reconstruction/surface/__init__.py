"""Stage 5: depth maps -> one fused surface, its planes, and what is known of free space."""

from reconstruction.surface.config import SURFACE_PRESETS, SurfaceConfig
from reconstruction.surface.fuse import fuse_surface

__all__ = ["SURFACE_PRESETS", "SurfaceConfig", "fuse_surface"]
