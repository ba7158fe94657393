"""Refine depth maps by the depth rendered from the fitted Gaussians, which fuse all frames."""

from dataclasses import replace

import numpy as np

from reconstruction.core.progress import Progress
from reconstruction.core.types import Camera, DepthMaps, PosedFrames
from reconstruction.depth import DepthConfig
from reconstruction.depth.views import plan_views
from reconstruction.gaussians.backend import Backend
from reconstruction.gaussians.config import GaussiansConfig
from reconstruction.gaussians.model import Gaussians
from reconstruction.gaussians.rasterizer import RasterSettings
from reconstruction.gaussians.rendering import Render
from registry.geometry import invert_rigid

_SOLID = 0.5  # opacity from which a pixel shows a surface
_SAME = 0.015  # largest relative depth difference at which another view agrees
_BEYOND = 1.025  # smallest depth ratio at which another view sees through a point
_OWN_WITNESSES = 2  # agreeing neighbors that keep a measured depth without the Gaussians' support
_FAR_OFF = 0.1  # smallest relative difference of expected and measured depth for that
_BADLY_EXPLAINED = 0.05  # share of a frame's known pixels that may be dropped before neighbors may keep them


def rendered_depth_maps(
    gaussians: Gaussians,
    posed: PosedFrames,
    depth: DepthMaps,
    config: GaussiansConfig,
    settings: RasterSettings,
    backend: Backend,
    progress: Progress,
) -> DepthMaps:
    """Return depth maps with the expected depth of the Gaussians where it is unambiguous and confirmed.

    A pixel is clear if expected and median depth agree, that is, if it shows one surface.

    - Clear, and the measured depth is close to the expected: the expected depth.
    - Not clear (occlusion boundary): the measured depth if expected or median depth confirms it.
    - Otherwise the depth maps of neighboring frames vote. The expected depth wins if more of them support it. The
      measured depth wins if two support it, none supports the expected, and that is far off (a floater). Otherwise the
      pixel becomes unknown.
    - If too many pixels of a frame would become unknown, the Gaussians explain it badly: measured depth that two
      neighbors support is kept.

    Unknown pixels stay unknown. Confidence is that of the input.

    Args:
        gaussians: of `fit_gaussians` on these depth maps; their cameras are used.
        posed: the frames, which determine the neighbors.
        depth: one map per keyframe, in the units of the cameras.
        config: `clear_depth` and `confirmed_depth` are the relative differences that count as agreement.
        settings: of the rasterizer.
        backend: renders the Gaussians.
        progress: receives steps and a summary.
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
                _witnesses(row, candidate, asked, measured, neighbors[row], relative, depth.camera)
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
    """Return depth (h, w) decided without a vote, 0 = none; the masks of pixels that need one, and of clear ones."""
    expected, median, solid = render.depth, render.median_depth, render.opacity > _SOLID
    clear = solid & (np.abs(expected - median) < config.clear_depth * expected)
    near = np.abs(expected - own) < config.confirmed_depth * own
    confirmed = near | (np.abs(median - own) < config.confirmed_depth * own) | ~solid
    kept = np.where(clear & near, expected, np.where(~clear & confirmed, own, 0))
    return kept.astype(np.float32), (kept == 0) & (own > 0), clear


def _witnesses(
    row: int, candidate: np.ndarray, asked: np.ndarray, measured: np.ndarray, neighbors: np.ndarray,
    relative: np.ndarray, camera: Camera,
) -> np.ndarray:  # fmt: skip
    """Count per pixel (h, w) the neighboring depth maps that agree with a candidate depth (h, w), where `asked`."""
    from reconstruction.depth.consistency import count_witnesses

    k = camera.intrinsics
    agree, through = np.zeros(candidate.shape, np.uint8), np.zeros(candidate.shape, np.uint8)
    before = measured[row].copy()
    measured[row] = candidate  # the kernel reads the depth to test from the stack
    count_witnesses(row, neighbors, measured, asked, relative, k, _BEYOND, _SAME, agree, through)
    measured[row] = before
    return agree.astype(np.int32)


def _vote(
    own: np.ndarray, expected: np.ndarray, clear: np.ndarray, for_own: np.ndarray, for_expected: np.ndarray
) -> np.ndarray:
    """Return the depth (h, w) that the neighbors' support decides for, 0 = undecided."""
    far_off = np.abs(expected - own) > _FAR_OFF * own
    alone = (for_expected == 0) & (for_own >= _OWN_WITNESSES) & far_off
    decided = np.where(clear & (for_expected > for_own), expected, np.where(clear & alone, own, 0))
    return decided.astype(np.float32)
