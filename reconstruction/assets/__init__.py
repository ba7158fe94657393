"""Stage 7, assets: closed, textured objects with collision shapes and masses; textured floor, walls and ceiling."""

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
    """Build every asset; see `reconstruction.assets.build.build_assets`, whose compiled code is imported on use."""
    from reconstruction.assets.build import build_assets as build

    return build(posed, depth, surface, instances, config, views=views, keep=keep, progress=progress)


def wants_views(config: AssetsConfig) -> bool:
    """Tell whether a generator or a vision-language model needs views of the objects."""
    return config.generator != "none" or config.physics != "table"
