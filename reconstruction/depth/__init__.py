"""Stage 3: posed frames -> a depth map of every keyframe."""

from reconstruction.depth.config import DEPTH_PRESETS, DepthConfig
from reconstruction.depth.estimate import estimate_depth

__all__ = ["DEPTH_PRESETS", "DepthConfig", "estimate_depth"]
