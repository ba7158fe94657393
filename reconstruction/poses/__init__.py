"""Stage 2: poses. A `FrameSet` in, `PosedFrames` in `sfm` space out."""

from reconstruction.poses.config import POSES_PRESETS, PosesConfig
from reconstruction.poses.estimate import estimate_poses

VERSION = 2

__all__ = ["POSES_PRESETS", "VERSION", "PosesConfig", "estimate_poses"]
