"""Stage 5: fuse depth maps into one surface mesh, its planes and an occupancy grid."""

from reconstruction.surface.config import SURFACE_PRESETS, SurfaceConfig
from reconstruction.surface.fuse import fuse_surface

__all__ = ["SURFACE_PRESETS", "SurfaceConfig", "fuse_surface"]
