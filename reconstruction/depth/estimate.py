"""Stage 3: posed frames -> depth maps."""

from dataclasses import replace

import numpy as np

from reconstruction.core.progress import NO_PROGRESS, Progress
from reconstruction.core.types import Camera, DepthMaps, PosedFrames
from reconstruction.core.workers import Workers
from reconstruction.depth.config import DepthConfig
from reconstruction.depth.evidence import PREDICTED, Evidence, count_views, inverse
from reconstruction.depth.images import gray_images, sized_camera, small_color
from reconstruction.depth.monocular import MonocularBackend, fill_from_predictions, load_monocular
from reconstruction.depth.perturb import perturbed
from reconstruction.depth.views import ViewPlan, plan_views
from registry.errors import InputError
from registry.geometry import invert_rigid

_COMPLETED_SAY = 0.3  # what a completed pixel is worth beside the correlation of a measured one
_BEND_REACH = 0.06  # of the width: how far known depth bends predictions beside it
_SURE_CORRELATION = 0.5  # a pixel that changed its surface counts as measured from here on


def _warps(posed: PosedFrames, camera: Camera, i: int, sources: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (s, 3, 3) and (s, 3): a pixel p of frame i at inverse depth rho is at h_inf @ p + rho * shift."""
    k, k_inv = camera.matrix, np.linalg.inv(camera.matrix)
    relative = invert_rigid(posed.world_from_camera[sources]) @ posed.world_from_camera[i]
    return k @ relative[:, :3, :3] @ k_inv, relative[:, :3, 3] @ k.T


def sweep_frame(i, gray, posed, camera: Camera, plan: ViewPlan, rhos: np.ndarray, noise: float) -> np.ndarray:
    """Return the cost uint8 (h, w, planes) of every inverse depth at every pixel, each part by its own sources."""
    from reconstruction.depth.sweep import REACH_PX, sweep_costs

    cost = np.full((camera.height, camera.width, len(rhos)), 127, np.uint8)
    for (top, bottom, left, right), sources in plan.parts_with_sources(i, camera.height, camera.width):
        # Windows at the border of a part reach into the next one.
        y, x = max(0, top - REACH_PX), max(0, left - REACH_PX)
        wide = np.ascontiguousarray(gray[i, y : bottom + REACH_PX, x : right + REACH_PX])
        h_inf, shift = _warps(posed, camera, i, sources)
        h_inf[:, :, 2] += h_inf[:, :, 0] * x + h_inf[:, :, 1] * y  # pixels are counted from the part's corner
        own = np.empty((len(rhos), *wide.shape), np.uint8)
        sweep_costs(wide, gray[sources], h_inf, shift, rhos, noise, own)
        own = own[:, top - y : bottom - y, left - x : right - x]
        cost[top:bottom, left:right] = np.moveaxis(own, 0, 2)
    return cost


def winner_of(cost: np.ndarray, gray: np.ndarray, rhos: np.ndarray, config: DepthConfig) -> np.ndarray:
    """Return the inverse depth float32 (h, w) that semi-global aggregation of a cost volume (h, w, planes) chooses."""
    from reconstruction.depth.sgm import aggregate, winner

    p1 = np.int32(max(1, round(127 * config.smooth_small)))
    p2 = np.int32(round(127 * config.smooth_large))
    total = np.zeros(cost.shape, np.uint16)
    aggregate(cost, gray, p1, p2, p1 + np.int32(1), 8.0, total)
    out = np.empty(cost.shape[:2], np.float32)
    winner(total, rhos, out)
    return out


def _measure(posed, camera: Camera, plan: ViewPlan, config: DepthConfig, workers, progress):
    """Sweep, aggregate and refine every frame; return inverse depth and correlation (n, h, w).

    Beside them the learned aggregation's inverse depth and the probability of its surface (n, h, w), empty without it.
    """
    import cv2

    from reconstruction.depth.aggregation import aggregate_costs
    from reconstruction.depth.edges import sharpen_edges
    from reconstruction.depth.refine import fit_slopes, refine

    learned = config.prior == "both"
    small = sized_camera(camera, config.sweep_side_px)
    fine_gray, small_gray = gray_images(posed.images, camera), gray_images(posed.images, small)
    shape = (camera.height, camera.width)
    rho_all = np.zeros((len(fine_gray), *shape), np.float32)
    score_all = np.full((len(fine_gray), *shape), -1.0, np.float32)
    predicted_all = np.zeros(rho_all.shape if learned else 0, np.float32)
    surety_all = np.zeros_like(predicted_all)
    fine_size = (camera.width, camera.height)

    def work(i: int) -> None:
        parts = list(plan.parts_with_sources(i, *shape))
        if not parts:
            return
        rhos = np.linspace(1.0 / plan.far[i], 1.0 / plan.near[i], config.planes)
        cost = sweep_frame(i, small_gray, posed, small, plan, rhos, config.noise_gray)
        coarse = winner_of(cost, small_gray[i], rhos, config)
        if learned:
            picture, penalties = (
                small_color(posed.images[i], small),
                (config.smooth_small, config.smooth_large),
            )
            predicted, sure = aggregate_costs(cost, picture, small_gray[i], rhos, penalties)
            predicted_all[i] = cv2.resize(predicted, fine_size, interpolation=cv2.INTER_NEAREST)
            surety_all[i] = cv2.resize(sure, fine_size, interpolation=cv2.INTER_NEAREST)
        rho = cv2.resize(coarse, fine_size, interpolation=cv2.INTER_NEAREST)
        warps = [(fine_gray[sources], *_warps(posed, camera, i, sources)) for _, sources in parts]
        fitted, gx, gy = (np.empty(shape, np.float32) for _ in range(3))
        score = np.full(shape, -1.0, np.float32)
        # The first step covers the spacing of the sweep's planes, later ones go for fractions of a pixel.
        for step_px in (0.7, 0.35, 0.2, 0.2)[: config.refine_rounds]:
            fit_slopes(rho, 0.012, fitted, gx, gy)
            for (bounds, _), (seen, h_inf, shift) in zip(parts, warps):
                refine(
                    fine_gray[i], seen, h_inf, shift, fitted, gx, gy, step_px, config.noise_gray, bounds, rho, score
                )  # fmt: skip
        score_all[i] = score
        fit_slopes(rho, 0.012, fitted, gx, gy)
        sharpen_edges(rho, gx, gy, score, small_color(posed.images[i], camera), rho_all[i])

    workers.each(len(fine_gray), work, "measuring depth", progress)
    return rho_all, score_all, predicted_all, surety_all


def _agree(posed, camera: Camera, plan: ViewPlan, depth, score, config: DepthConfig, workers, progress):
    """Keep what other views confirm; return depth and the number of agreeing views (n, h, w)."""
    from reconstruction.depth.consistency import check_view, remove_speckles

    k = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    weight = np.clip(score, 0.0, 1.0) ** 2
    fused, count = np.zeros_like(depth), np.zeros(depth.shape, np.uint8)

    def work(i: int) -> None:
        rows = plan.neighbors[i]
        relative = invert_rigid(posed.world_from_camera[np.maximum(rows, 0)]) @ posed.world_from_camera[i]
        check_view(
            i, rows, depth, weight, relative, k, config.agree_depth, config.agree_px, count[i], fused[i]
        )
        # A window without contrast correlates with anything a little: such depth needs more witnesses.
        good = (count[i] >= config.min_agreeing) & (score[i] >= config.min_correlation)
        good |= (count[i] >= 2 * config.min_agreeing) & (score[i] >= 0.6 * config.min_correlation)
        fused[i] *= good
        fused[i] *= remove_speckles(fused[i], config.min_speckle_px, 0.02)

    workers.each(len(depth), work, "comparing views", progress)
    return fused, count


def _fill_predicted(
    posed,
    camera: Camera,
    plan: ViewPlan,
    predicted,
    surety,
    depth,
    confidence,
    config: DepthConfig,
    workers,
    progress,
) -> tuple[np.ndarray, np.ndarray]:
    """Fill unknown depth where the network is sure and other views see or predict the same; return both maps anew.

    Each frame's prediction is first bent onto the depth that is known around a hole.
    """
    from reconstruction.depth.consistency import check_view, count_witnesses, remove_speckles
    from reconstruction.depth.monocular import residual_field

    k = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    said, taken = depth.copy(), np.zeros_like(depth)
    weight = np.where(depth > 0, 1.0, surety).astype(np.float32)
    reach, reach_px = config.prior_agree_depth, config.prior_agree_px

    def bend(i: int) -> None:
        rho = np.maximum(predicted[i], 1e-9)
        ratio = 1.0 / (np.maximum(depth[i], 1e-9) * rho)
        near = (depth[i] > 0) & (np.abs(ratio - 1) < 4 * reach)
        bent = 1.0 / (rho * np.exp(residual_field(ratio, near, _BEND_REACH * camera.width)))
        said[i] = np.where(
            (depth[i] == 0) & (predicted[i] > 0) & (surety[i] >= config.prior_surety), bent, depth[i]
        )

    def believe(i: int) -> None:
        rows = plan.neighbors[i]
        relative = invert_rigid(posed.world_from_camera[np.maximum(rows, 0)]) @ posed.world_from_camera[i]
        count, fused = np.zeros(depth.shape[1:], np.uint8), np.zeros(depth.shape[1:], np.float32)
        check_view(i, rows, said, weight, relative, k, reach, reach_px, count, fused)
        asked = (depth[i] == 0) & (said[i] > 0)
        agree, through = np.zeros_like(count), np.zeros_like(count)
        count_witnesses(i, rows, said, asked, relative, k, 1.0 + 2 * reach, 0.5 * reach, agree, through)
        taken[i] = np.where(asked & (count >= config.min_agreeing) & (count > through), fused, 0)
        together = np.where(depth[i] > 0, depth[i], taken[i])
        taken[i] *= remove_speckles(together, config.min_speckle_px, reach)

    workers.each(len(depth), bend, "bending predictions", progress)
    workers.each(len(depth), believe, "comparing predictions", progress)
    progress.note(f"depth: the network filled {100 * float((taken > 0).mean()):.1f} % of the pixels")
    return np.where(taken > 0, taken, depth), np.where(taken > 0, 1, confidence).astype(np.uint8)


def _resolve(
    posed, camera: Camera, plan: ViewPlan, depth, confidence, score, config: DepthConfig, workers, progress
):
    """Put depth edges where the image has them, and drop what other views look through; return both maps anew."""
    from reconstruction.depth.consistency import remove_speckles
    from reconstruction.depth.outlines import mark_doubt, resolve_edges
    from reconstruction.depth.refine import fit_slopes

    gray = gray_images(posed.images, camera)
    shape = (camera.height, camera.width)
    moved, trust = np.zeros_like(depth), confidence.copy()
    doubts = np.zeros(depth.shape, bool)

    def work(i: int) -> None:
        moved[i] = depth[i]
        parts = list(plan.parts_with_sources(i, *shape))
        if not parts:
            return
        warps = [(gray[sources], *_warps(posed, camera, i, sources)) for _, sources in parts]
        color = small_color(posed.images[i], camera)
        rho = inverse(depth[i])
        sure = np.choose(confidence[i], [np.float32(0), np.float32(_COMPLETED_SAY), score[i]]).astype(
            np.float32
        )
        before = rho
        # A skirt is wider than a step: what was put right in the first round speaks in the next ones.
        for band in (8, 4)[: config.edge_rounds]:
            fitted, gx, gy = (np.empty(shape, np.float32) for _ in range(3))
            fit_slopes(rho, 0.012, fitted, gx, gy)
            doubt = np.empty(shape, bool)
            mark_doubt(rho, gx, gy, 0.025, band, doubt)
            out, out_sure = rho.copy(), sure.copy()
            for (bounds, _), (seen, h_inf, shift) in zip(parts, warps):
                resolve_edges(
                    gray[i], color, seen, h_inf, shift, rho, gx, gy, sure, doubt, config.noise_gray, bounds,
                    out, out_sure,
                )  # fmt: skip
            rho, sure = out, out_sure
            doubts[i] |= doubt
        changed = rho != before
        moved[i][changed] = 1.0 / rho[changed]
        trust[i][changed] = np.where(sure[changed] >= _SURE_CORRELATION, 2, 1)

    workers.each(len(depth), work, "placing edges", progress)
    agree, through = count_views(moved, posed, camera, plan.neighbors, workers.each, progress, doubts)
    out = moved.copy()

    def check(i: int) -> None:
        drop = doubts[i] & (through[i] >= 3) & (through[i] > agree[i] + 1)
        # Single pixels that chose otherwise than all around them become flakes in the air.
        drop |= doubts[i] & (moved[i] > 0) & ~remove_speckles(moved[i], config.min_speckle_px // 4, 0.02)
        out[i][drop] = 0
        trust[i][drop] = 0

    workers.each(len(depth), check, "looking through", progress)
    return out, trust


def gather_evidence(
    posed: PosedFrames,
    config: DepthConfig,
    *,
    backend: MonocularBackend | None = None,
    keep_agreed: bool = False,
    progress: Progress = NO_PROGRESS,
) -> Evidence:
    """Measure every keyframe, complete it by planes and predictions; return the maps and where each pixel is from.

    Args:
        posed: As of `estimate_depth`, like all others.
        config: Settings.
        backend: Learned depth, or None.
        keep_agreed: Whether `Evidence.agreed` is kept, too.
        progress: Where steps and decisions are reported.
    """
    camera = sized_camera(posed.camera, config.depth_side_px)
    plan = plan_views(posed, config)
    workers = Workers(config.threads)
    rho, score, predicted, surety = _measure(posed, camera, plan, config, workers, progress)
    raw = inverse(rho)
    depth, _ = _agree(posed, camera, plan, raw, score, config, workers, progress)
    agreed = depth.copy() if keep_agreed else np.zeros(0, np.float32)
    confidence = np.where(depth > 0, 2, 0).astype(np.uint8)
    share = float((confidence == 2).mean())
    if share < 0.02:
        raise InputError(
            f"depth: only {100 * share:.1f} % of the pixels could be measured. The frames are blurred, blank or do "
            "not move sideways: film textured things with steady sideways motion and enough light."
        )
    if config.complete:
        from reconstruction.depth.complete import complete_depth

        depth, confidence = complete_depth(posed, camera, plan, depth, raw, config, workers.each, progress)
    if config.edge_rounds > 0:
        depth, confidence = _resolve(posed, camera, plan, depth, confidence, score, config, workers, progress)
    filled = np.zeros(depth.shape, bool)
    if len(predicted):
        unknown = depth == 0
        depth, confidence = _fill_predicted(
            posed, camera, plan, predicted, surety, depth, confidence, config, workers, progress
        )
        filled = unknown & (depth > 0)
    if backend is not None:
        depth, confidence = fill_from_predictions(
            posed, camera, plan, depth, confidence, backend, config, workers.each, progress
        )
    progress.note(
        f"depth: {100 * share:.0f} % of the pixels measured, {100 * float((confidence == 1).mean()):.0f} % completed"
    )
    origin = np.where(filled, PREDICTED, confidence).astype(np.uint8)
    return Evidence(camera, plan.neighbors, depth, origin, score, surety, agreed)


def estimate_depth(
    posed: PosedFrames,
    config: DepthConfig,
    *,
    backend: MonocularBackend | None = None,
    progress: Progress = NO_PROGRESS,
) -> DepthMaps:
    """Estimate one depth map for every posed keyframe, in the units of the poses.

    Args:
        posed: Frames with cameras and sparse points, in any space and scale.
        config: Settings.
        backend: Learned depth for what is left unknown; None: the one that `config.monocular` names, if any.
        progress: Where steps and decisions are reported.
    """
    backend = backend or load_monocular(
        config
    )  # a model that is not there is told before the work, not after
    found = gather_evidence(posed, config, backend=backend, progress=progress)
    if config.prior != "none":
        from reconstruction.depth.mending import drop_unconfirmed, mend_depth

        each = Workers(config.threads).each
        mended = mend_depth(found, posed, config.mend_surety, config.fill_surety, each, progress)
        found = drop_unconfirmed(mended, found.depth, posed, config.min_agreeing, each, progress)
    maps = found.maps()
    return replace(maps, depth=perturbed(maps.depth, config.perturb)) if config.perturb else maps
