"""Stage 7, assets: complete, textured, simulation-ready objects, and floor and walls with their looks."""

from reconstruction.assets.config import ASSETS_PRESETS, AssetsConfig
from reconstruction.assets.physics.load import outside_inputs
from reconstruction.progress import NO_PROGRESS, Progress
from reconstruction.types import AssetSet, DepthMaps, InstanceSet, PosedFrames, Surface

__all__ = ("ASSETS_PRESETS", "VERSION", "AssetsConfig", "build_assets", "outside_inputs")

VERSION = 9


def build_assets(
    posed: PosedFrames, depth: DepthMaps, surface: Surface, instances: InstanceSet, config: AssetsConfig, *,
    progress: Progress = NO_PROGRESS,
) -> AssetSet:  # fmt: skip
    """Build every asset; see `reconstruction.assets.build.build_assets` (compiled code is imported on use)."""
    from reconstruction.assets.build import build_assets as build

    return build(posed, depth, surface, instances, config, progress=progress)
