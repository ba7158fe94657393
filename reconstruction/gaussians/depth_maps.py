"""Depth maps as the fitted Gaussians show them: every frame corrected by what all frames agree on."""

import numpy as np

from reconstruction.gaussians.backends import Backend
from reconstruction.gaussians.config import GaussiansConfig
from reconstruction.gaussians.model import Gaussians
from reconstruction.gaussians.rasterizer import RasterSettings
from reconstruction.progress import Progress
from reconstruction.types import DepthMaps

_SOLID = 0.5  # opacity from which a pixel shows a surface


def rendered_depth_maps(
    gaussians: Gaussians,
    depth: DepthMaps,
    config: GaussiansConfig,
    settings: RasterSettings,
    backend: Backend,
    progress: Progress,
) -> DepthMaps:
    """Return the depth maps with the depth of the Gaussians where it is unambiguous.

    A pixel takes the expected depth where expected and median depth agree, that is where one surface stops the
    light. Elsewhere (at outlines the expected depth lies between two surfaces) it keeps its own depth if either of
    them confirms it, and becomes unknown if not. Pixels that were unknown stay so: what Gaussians show there was
    never measured in this view. Confidence is that of the input.

    Args:
        gaussians: of `fit_gaussians` on these depth maps; their cameras are used.
        depth: one map per keyframe, in the units of the cameras.
        config: `clear_depth` and `confirmed_depth` are the relative differences that count as agreement.
        settings: of the rasterizer.
        backend: that renders.
        progress: told of every frame.
    """
    parameters = gaussians.packed()
    refined = np.zeros(depth.depth.shape, np.float32)
    progress.start(len(refined), "depth of the Gaussians")
    changed = dropped = known = 0
    for row, pose in enumerate(gaussians.world_from_camera):
        render = backend.render(parameters, depth.camera, pose, settings)
        own = np.asarray(depth.depth[row])
        has = (own > 0) & (np.asarray(depth.confidence[row]) > 0)
        refined[row] = np.where(
            has, _choose(own, render.depth, render.median_depth, render.opacity, config), 0
        )
        known += int(has.sum())
        changed += int((has & (np.abs(refined[row] - own) > config.clear_depth * own)).sum())
        dropped += int((has & (refined[row] == 0)).sum())
        progress.advance()
    confidence = np.where(refined > 0, depth.confidence, 0).astype(np.uint8)
    progress.note(
        f"gaussians: {100 * dropped / max(known, 1):.1f} % of the known depth contradicted and dropped, "
        f"{100 * (changed - dropped) / max(known, 1):.1f} % moved by more than {100 * config.clear_depth:g} %"
    )
    return DepthMaps(depth.camera, refined, confidence)


def _choose(
    own: np.ndarray, expected: np.ndarray, median: np.ndarray, opacity: np.ndarray, config: GaussiansConfig
) -> np.ndarray:
    clear = (opacity > _SOLID) & (np.abs(expected - median) < config.clear_depth * expected)
    confirmed = np.minimum(np.abs(median - own), np.abs(expected - own)) < config.confirmed_depth * own
    return np.where(clear, expected, np.where(confirmed | (opacity <= _SOLID), own, 0))
