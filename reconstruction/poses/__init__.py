"""Stage 2, structure from motion: a `FrameSet` in, `PosedFrames` in `sfm` space out."""

from pathlib import Path

from reconstruction.cache import digest_input
from reconstruction.poses.config import POSES_PRESETS, PosesConfig
from reconstruction.poses.estimate import estimate_poses


def outside_inputs(config: PosesConfig) -> tuple[str, ...]:
    """Return the digest of imported pose files, which become part of the cache key."""
    path = Path(config.import_path) if config.import_path else None
    return (digest_input(path),) if path is not None and path.exists() else ()


__all__ = ["POSES_PRESETS", "PosesConfig", "estimate_poses", "outside_inputs"]
