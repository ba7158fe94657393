"""Depth maps as the fitted Gaussians show them: every frame corrected by what all frames agree on."""

from dataclasses import replace

import numpy as np

from reconstruction.core.progress import Progress
from reconstruction.core.types import DepthMaps, PosedFrames
from reconstruction.depth import DepthConfig
from reconstruction.depth.views import plan_views
from reconstruction.gaussians.backend import Backend
from reconstruction.gaussians.config import GaussiansConfig
from reconstruction.gaussians.model import Gaussians
from reconstruction.gaussians.rasterizer import RasterSettings
from reconstruction.gaussians.rendering import Render
from registry.geometry import invert_rigid

_SOLID = 0.5  # opacity from which a pixel shows a surface
_SAME, _BEYOND = (
    0.015,
    1.025,
)  # relative depth up to which, ratio from which another view sees the same, looks through
_OWN_WITNESSES, _FAR_OFF = 2, 0.1
_BADLY_EXPLAINED = 0.05  # share of a frame's known pixels


def rendered_depth_maps(
    gaussians: Gaussians,
    posed: PosedFrames,
    depth: DepthMaps,
    config: GaussiansConfig,
    settings: RasterSettings,
    backend: Backend,
    progress: Progress,
) -> DepthMaps:
    """Return the depth maps with the depth of the Gaussians where it is unambiguous and others bear it out.

    A pixel takes the expected depth where expected and median depth agree, that is where one surface stops the light,
    and its own depth is about the same. Where its own depth is another, the depth maps of neighboring frames vote: it
    takes the expected depth if more of them measured that, keeps its own if Gaussians stand alone far off from a
    surface that others measured (floaters of a weak capture), and becomes unknown otherwise. At outlines, where the
    expected depth lies between two surfaces, it keeps its own depth if either of the two confirms it. A frame in which
    much would become unknown is one that the Gaussians explain badly: there, what two neighbors measured stays. Pixels
    that were unknown stay so: what Gaussians show there was never measured in this view. Confidence is that of the
    input.

    Args:
        gaussians: of `fit_gaussians` on these depth maps; their cameras are used.
        posed: the frames, for which frames are neighbors.
        depth: one map per keyframe, in the units of the cameras.
        config: `clear_depth` and `confirmed_depth` are the relative differences that count as agreement.
        settings: of the rasterizer.
        backend: that renders.
        progress: told of every frame.
    """
    parameters, poses = gaussians.packed(), gaussians.world_from_camera
    neighbors = plan_views(posed, DepthConfig()).neighbors
    measured = np.array(depth.depth, np.float32)
    refined = np.zeros_like(measured)
    progress.start(len(refined), "depth of the Gaussians")
    moved = dropped = known = 0
    for row, pose in enumerate(poses):
        own = measured[row].copy()
        has = (own > 0) & (np.asarray(depth.confidence[row]) > 0)
        render = backend.render(parameters, depth.camera, pose, settings)
        kept, asked, clear = _choose(own, render, config)
        if asked.any():
            relative = invert_rigid(poses[np.maximum(neighbors[row], 0)]) @ pose
            support = [
                _witnesses(row, candidate, asked, measured, neighbors[row], relative, depth)
                for candidate in (own, np.asarray(render.depth, np.float32))
            ]
            decided = _vote(own, render.depth, clear, *support)
            if ((decided == 0) & asked & has).sum() > _BADLY_EXPLAINED * max(int(has.sum()), 1):
                decided = np.where((decided == 0) & (support[0] >= _OWN_WITNESSES), own, decided)
            kept = np.where(asked, decided, kept)
        refined[row] = np.where(has, kept, 0)
        known += int(has.sum())
        moved += int((has & (kept > 0) & (np.abs(kept - own) > config.clear_depth * own)).sum())
        dropped += int((has & (kept == 0)).sum())
        progress.advance()
    confidence = np.where(refined > 0, depth.confidence, 0).astype(np.uint8)
    progress.note(
        f"gaussians: {100 * moved / max(known, 1):.1f} % of the known depth moved by more than "
        f"{100 * config.clear_depth:g} %, {100 * dropped / max(known, 1):.1f} % contradicted and dropped"
    )
    return replace(depth, depth=refined, confidence=confidence)


def _choose(
    own: np.ndarray, render: Render, config: GaussiansConfig
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the depth (h, w) that needs no vote, 0 = none; the pixels that need one; those that show one surface."""
    expected, median, solid = render.depth, render.median_depth, render.opacity > _SOLID
    clear = solid & (np.abs(expected - median) < config.clear_depth * expected)
    near = np.abs(expected - own) < config.confirmed_depth * own
    confirmed = near | (np.abs(median - own) < config.confirmed_depth * own) | ~solid
    kept = np.where(clear & near, expected, np.where(~clear & confirmed, own, 0))
    return kept.astype(np.float32), (kept == 0) & (own > 0), clear


def _witnesses(
    row: int,
    candidate: np.ndarray,
    asked: np.ndarray,
    measured: np.ndarray,
    neighbors: np.ndarray,
    relative: np.ndarray,
    depth: DepthMaps,
) -> np.ndarray:
    """Count the neighboring depth maps (h, w) that agree with a candidate depth (h, w) where asked."""
    from reconstruction.depth.consistency import count_witnesses

    camera = depth.camera
    k = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    agree, through = np.zeros(candidate.shape, np.uint8), np.zeros(candidate.shape, np.uint8)
    before = measured[row].copy()
    measured[row] = candidate  # the kernel reads the view's own depth from the stack
    count_witnesses(row, neighbors, measured, asked, relative, k, _BEYOND, _SAME, agree, through)
    measured[row] = before
    return agree.astype(np.int32)


def _vote(
    own: np.ndarray, expected: np.ndarray, clear: np.ndarray, for_own: np.ndarray, for_expected: np.ndarray
) -> np.ndarray:
    """Return what the neighbors decide (h, w), 0 where they do not."""
    far_off = np.abs(expected - own) > _FAR_OFF * own
    alone = (for_expected == 0) & (for_own >= _OWN_WITNESSES) & far_off
    return np.where(clear & (for_expected > for_own), expected, np.where(clear & alone, own, 0)).astype(
        np.float32
    )
