"""Depth edges at image edges: depth maps -> maps in which pixels beside depth jumps lie on the surface of their color.

Stereo windows that straddle an occlusion boundary give the background the depth of the foreground (edge fattening).
"""

import numpy as np

from reconstruction.core.workers import Workers
from reconstruction.depth.evidence import count_views, inverse
from reconstruction.depth.images import gray_images, small_color
from reconstruction.depth.scene import DepthScene, plane_warps

_BANDS_PX = (8, 4)  # beside a jump, by round: pixels put right in the first round vote in the second
_JUMP = 0.025  # relative step of inverse depth that the slopes do not explain
_SURFACE_STEP = 0.012  # relative change of inverse depth from pixel to pixel up to which a surface goes on
_COMPLETED_SAY = 0.3  # weight of a completed pixel beside the correlation of a measured one
_SURE_CORRELATION = 0.5  # a pixel that changed its surface counts as measured from here on
_LOOK_THROUGH = 3  # views that see something beyond a point, from which it may be dropped


def place_edges(
    scene: DepthScene, depth: np.ndarray, confidence: np.ndarray, correlation: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Move depth edges to image edges, and drop pixels beside them that other views look through.

    Args:
        scene: keyframes with their plan.
        depth: float32 (n, h, w), 0 = unknown.
        confidence: uint8 (n, h, w), 2 measured, 1 completed, 0 unknown.
        correlation: float32 (n, h, w) of the windows.

    Returns:
        Depth and confidence anew.
    """
    from reconstruction.depth.consistency import remove_speckles

    gray = gray_images(scene.posed.images, scene.camera)
    moved, trust, doubts = depth.copy(), confidence.copy(), np.zeros(depth.shape, bool)

    def work(i: int) -> None:
        rho = inverse(depth[i])
        sure = np.choose(confidence[i], [np.float32(0), np.float32(_COMPLETED_SAY), correlation[i]])
        now, now_sure = _reassigned(scene, i, gray, rho, sure.astype(np.float32), doubts[i])
        changed = now != rho
        moved[i][changed] = 1.0 / now[changed]
        trust[i][changed] = np.where(now_sure[changed] >= _SURE_CORRELATION, 2, 1)

    scene.each(work, "placing edges")
    agree, through = count_views(
        moved, scene.posed, scene.camera, scene.plan.neighbors, Workers(scene.config.threads).each, scene.progress,
        doubts,
    )  # fmt: skip
    out = moved.copy()

    def check(i: int) -> None:
        drop = doubts[i] & (through[i] >= _LOOK_THROUGH) & (through[i] > agree[i] + 1)
        # Single pixels that chose otherwise than all around them become flying pixels.
        drop |= (
            doubts[i] & (moved[i] > 0) & ~remove_speckles(moved[i], scene.config.min_speckle_px // 4, 0.02)
        )
        out[i][drop] = 0
        trust[i][drop] = 0

    scene.each(check, "looking through")
    return out, trust


def _reassigned(
    scene: DepthScene, i: int, gray: np.ndarray, rho: np.ndarray, sure: np.ndarray, doubts: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return inverse depth and surety (h, w) after pixels beside jumps chose their surface; `doubts` marks them."""
    from reconstruction.depth.outlines import edge_voters, mark_doubt, resolve_edges
    from reconstruction.depth.refine import fit_slopes

    parts = list(scene.plan.parts_with_sources(i, *scene.shape))
    if not parts:
        return rho, sure
    warps = [(gray[sources], *plane_warps(scene.posed, scene.camera, i, sources)) for _, sources in parts]
    color = small_color(scene.posed.images[i], scene.camera)
    for band in _BANDS_PX[: scene.config.edge_rounds]:
        fitted, gx, gy = (np.empty(scene.shape, np.float32) for _ in range(3))
        fit_slopes(rho, _SURFACE_STEP, fitted, gx, gy)
        doubt = np.empty(scene.shape, bool)
        mark_doubt(rho, gx, gy, _JUMP, band, doubt)
        voting = edge_voters(rho, sure, doubt, color)
        out, out_sure = rho.copy(), sure.copy()
        for (bounds, _), (seen, h_inf, shift) in zip(parts, warps):
            resolve_edges(
                gray[i], color, seen, h_inf, shift, rho, gx, gy, sure, doubt, voting, scene.config.noise_gray, bounds,
                out, out_sure,
            )  # fmt: skip
        rho, sure = out, out_sure
        doubts |= doubt
    return rho, sure
