"""Stage 7, assets: complete, textured, simulation-ready objects, and floor and walls with their looks."""

from pathlib import Path

from reconstruction.assets.config import ASSETS_PRESETS, AssetsConfig
from reconstruction.assets.physics.load import outside_inputs
from reconstruction.core.progress import NO_PROGRESS, Progress
from reconstruction.core.types import AssetSet, DepthMaps, InstanceSet, PosedFrames, Surface
from reconstruction.views import SceneViews

__all__ = ("ASSETS_PRESETS", "AssetsConfig", "build_assets", "outside_inputs", "wants_views")


def build_assets(
    posed: PosedFrames, depth: DepthMaps, surface: Surface, instances: InstanceSet, config: AssetsConfig, *,
    views: SceneViews | None = None, keep: Path | None = None, progress: Progress = NO_PROGRESS,
) -> AssetSet:  # fmt: skip
    """Build every asset; see `reconstruction.assets.build.build_assets` (compiled code is imported on use)."""
    from reconstruction.assets.build import build_assets as build

    return build(posed, depth, surface, instances, config, views=views, keep=keep, progress=progress)


def wants_views(config: AssetsConfig) -> bool:
    """Tell whether objects are shown to anyone: a generator, or a vision-language model."""
    return config.generator != "none" or config.physics == "vlm"
