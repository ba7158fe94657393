"""Consistency between views: measured or predicted depth maps -> the pixels that other views confirm."""

import numpy as np

from reconstruction.depth.scene import DepthScene

_BEND_REACH = 0.06  # of the width: known depth corrects predictions up to here
_JUMP = 0.02  # relative step of depth that cuts pieces apart


def keep_confirmed(scene: DepthScene, depth: np.ndarray, correlation: np.ndarray) -> np.ndarray:
    """Keep measured pixels that enough other views confirm, with the mean depth of all that agree.

    Args:
        scene: keyframes with their plan.
        depth: float32 (n, h, w), 0 = unknown.
        correlation: float32 (n, h, w) of the windows, the weight of a pixel.

    Returns:
        float32 (n, h, w), 0 = not confirmed.
    """
    from reconstruction.depth.consistency import check_view, remove_speckles

    config = scene.config
    weight = np.clip(correlation, 0.0, 1.0) ** 2
    fused, count = np.zeros_like(depth), np.zeros(depth.shape, np.uint8)

    def work(i: int) -> None:
        rows, relative = scene.neighbors(i)
        check_view(
            i, rows, depth, weight, depth[i] > 0, relative, scene.camera.intrinsics, config.agree_depth,
            config.agree_px, count[i], fused[i],
        )  # fmt: skip
        # A window without contrast correlates with anything a little: such depth needs more witnesses.
        good = (count[i] >= config.min_agreeing) & (correlation[i] >= config.min_correlation)
        good |= (count[i] >= 2 * config.min_agreeing) & (correlation[i] >= 0.6 * config.min_correlation)
        fused[i] *= good
        fused[i] *= remove_speckles(fused[i], config.min_speckle_px, _JUMP)

    scene.each(work, "comparing views")
    return fused


def fill_predicted(
    scene: DepthScene, predicted: np.ndarray, surety: np.ndarray, depth: np.ndarray, confidence: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Fill unknown depth with the learned aggregation's, where other views measure or predict the same.

    A view's prediction is first corrected by the known depth around each hole.

    Args:
        scene: keyframes with their plan.
        predicted: float32 (n, h, w) inverse depth.
        surety: float32 (n, h, w) its probability.
        depth: float32 (n, h, w) known depth, 0 = unknown.
        confidence: uint8 (n, h, w) of it.

    Returns:
        Depth and confidence anew; filled pixels have confidence 1.
    """
    from reconstruction.depth.consistency import check_view, count_witnesses, remove_speckles
    from reconstruction.depth.monocular import residual_field

    config, k = scene.config, scene.camera.intrinsics
    said, taken = depth.copy(), np.zeros_like(depth)
    weight = np.where(depth > 0, 1.0, surety).astype(np.float32)
    reach, reach_px = config.prior_agree_depth, config.prior_agree_px

    def bend(i: int) -> None:
        rho = np.maximum(predicted[i], 1e-9)
        ratio = 1.0 / (np.maximum(depth[i], 1e-9) * rho)
        near = (depth[i] > 0) & (np.abs(ratio - 1) < 4 * reach)
        bent = 1.0 / (rho * np.exp(residual_field(ratio, near, _BEND_REACH * scene.camera.width)))
        asked = (depth[i] == 0) & (predicted[i] > 0) & (surety[i] >= config.prior_surety)
        said[i] = np.where(asked, bent, depth[i])

    def believe(i: int) -> None:
        rows, relative = scene.neighbors(i)
        count, fused = np.zeros(scene.shape, np.uint8), np.zeros(scene.shape, np.float32)
        asked = (depth[i] == 0) & (said[i] > 0)
        check_view(i, rows, said, weight, asked, relative, k, reach, reach_px, count, fused)
        agree, through = np.zeros_like(count), np.zeros_like(count)
        count_witnesses(i, rows, said, asked, relative, k, 1.0 + 2 * reach, 0.5 * reach, agree, through)
        taken[i] = np.where(asked & (count >= config.min_agreeing) & (count > through), fused, 0)
        together = np.where(depth[i] > 0, depth[i], taken[i])
        taken[i] *= remove_speckles(together, config.min_speckle_px, reach)

    scene.each(bend, "bending predictions")
    scene.each(believe, "comparing predictions")
    scene.progress.note(f"depth: the network filled {100 * float((taken > 0).mean()):.1f} % of the pixels")
    return np.where(taken > 0, taken, depth), np.where(taken > 0, 1, confidence).astype(np.uint8)
