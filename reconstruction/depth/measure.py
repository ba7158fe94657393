"""Plane-sweep stereo: keyframes -> inverse depth and correlation of every pixel.

Costs of all planes at sweep resolution, semi-global aggregation (Hirschmueller, PAMI 2008), and local refinement with
slanted windows at depth resolution. Beside it the learned aggregation of the same costs, if the config asks for it.
"""

from dataclasses import dataclass

import numpy as np

from reconstruction.core.types import Camera, PosedFrames
from reconstruction.depth.config import DepthConfig
from reconstruction.depth.images import gray_images, sized_camera, small_color
from reconstruction.depth.scene import DepthScene, plane_warps
from reconstruction.depth.views import ViewPlan

_SURFACE_STEP = 0.012  # relative change of inverse depth from pixel to pixel up to which a surface goes on
_STEPS_PX = (0.7, 0.35, 0.2, 0.2)  # of the refinement: the first covers the spacing of the sweep's planes


@dataclass(frozen=True)
class Measured:
    """Raw measurements of all views, before they are compared with each other."""

    rho: np.ndarray  # float32 (n, h, w) inverse depth, 0 = none
    correlation: np.ndarray  # float32 (n, h, w) of the refined windows, -1 = none
    predicted: np.ndarray  # float32 (n, h, w) inverse depth by the learned aggregation, empty without it
    surety: np.ndarray  # float32 (n, h, w) probability of the predicted surface, empty without it


def measure_depth(scene: DepthScene) -> Measured:
    """Sweep, aggregate and refine every view.

    Args:
        scene: keyframes with their plan.
    """
    config, posed, n = scene.config, scene.posed, scene.count
    small = sized_camera(scene.camera, config.sweep_side_px)
    fine_gray, small_gray = gray_images(posed.images, scene.camera), gray_images(posed.images, small)
    learned = n if config.prior == "both" else 0
    rho, predicted, surety = (np.zeros((m, *scene.shape), np.float32) for m in (n, learned, learned))
    out = Measured(rho, np.full(rho.shape, -1.0, np.float32), predicted, surety)

    def work(i: int) -> None:
        if not len(list(scene.plan.parts_with_sources(i, *scene.shape))):
            return
        rhos = np.linspace(1.0 / scene.plan.far[i], 1.0 / scene.plan.near[i], config.planes)
        cost = sweep_frame(i, small_gray, posed, small, scene.plan, rhos, config.noise_gray)
        coarse = winner_of(cost, small_gray[i], rhos, config)
        if learned:
            _predict(scene, small, i, cost, small_gray[i], rhos, out)
        _refine(scene, i, _enlarged(coarse, scene.camera), fine_gray, out)

    scene.each(work, "measuring depth")
    return out


def sweep_frame(
    i: int, gray: np.ndarray, posed: PosedFrames, camera: Camera, plan: ViewPlan, rhos: np.ndarray, noise: float
) -> np.ndarray:  # fmt: skip
    """Return the matching cost uint8 (h, w, planes) of every inverse depth at every pixel of view i.

    Each part of the view is compared with sources of its own.

    Args:
        i: row of the view.
        gray: float32 (n, h, w) gray levels minus 128 of all views.
        posed: their cameras.
        camera: the camera at the resolution of `gray`.
        plan: sources of each part.
        rhos: float (planes,) inverse depths.
        noise: image noise in gray levels.
    """
    from reconstruction.depth.sweep import REACH_PX, sweep_costs

    cost = np.full((camera.height, camera.width, len(rhos)), 127, np.uint8)
    for (top, bottom, left, right), sources in plan.parts_with_sources(i, camera.height, camera.width):
        # Windows at the border of a part reach into the next one.
        y, x = max(0, top - REACH_PX), max(0, left - REACH_PX)
        wide = np.ascontiguousarray(gray[i, y : bottom + REACH_PX, x : right + REACH_PX])
        h_inf, shift = plane_warps(posed, camera, i, sources)
        h_inf[:, :, 2] += h_inf[:, :, 0] * x + h_inf[:, :, 1] * y  # pixels are counted from the part's corner
        own = np.empty((len(rhos), *wide.shape), np.uint8)
        sweep_costs(wide, gray[sources], h_inf, shift, rhos, noise, own)
        own = own[:, top - y : bottom - y, left - x : right - x]
        cost[top:bottom, left:right] = np.moveaxis(own, 0, 2)
    return cost


def winner_of(cost: np.ndarray, gray: np.ndarray, rhos: np.ndarray, config: DepthConfig) -> np.ndarray:
    """Return the inverse depth float32 (h, w) that semi-global aggregation of costs (h, w, planes) chooses."""
    from reconstruction.depth.sgm import aggregate, winner

    p1 = np.int32(max(1, round(127 * config.smooth_small)))
    p2 = np.int32(round(127 * config.smooth_large))
    total = np.zeros(cost.shape, np.uint16)
    aggregate(cost, gray, p1, p2, p1 + np.int32(1), 8.0, total)
    out = np.empty(cost.shape[:2], np.float32)
    winner(total, rhos, out)
    return out


def _enlarged(values: np.ndarray, camera: Camera) -> np.ndarray:
    import cv2

    return cv2.resize(values, (camera.width, camera.height), interpolation=cv2.INTER_NEAREST)


def _predict(
    scene: DepthScene, small: Camera, i: int, cost: np.ndarray, gray: np.ndarray, rhos: np.ndarray, out: Measured
) -> None:  # fmt: skip
    from reconstruction.depth.aggregation import aggregate_costs

    picture = small_color(scene.posed.images[i], small)
    penalties = (scene.config.smooth_small, scene.config.smooth_large)
    predicted, sure = aggregate_costs(cost, picture, gray, rhos, penalties)
    out.predicted[i], out.surety[i] = _enlarged(predicted, scene.camera), _enlarged(sure, scene.camera)


def _refine(scene: DepthScene, i: int, rho: np.ndarray, gray: np.ndarray, out: Measured) -> None:
    """Refine inverse depth (h, w) with slanted windows, and move it to image edges; written to `out`."""
    from reconstruction.depth.edges import sharpen_edges
    from reconstruction.depth.refine import fit_slopes, refine

    parts = list(scene.plan.parts_with_sources(i, *scene.shape))
    warps = [(gray[sources], *plane_warps(scene.posed, scene.camera, i, sources)) for _, sources in parts]
    fitted, gx, gy = (np.empty(scene.shape, np.float32) for _ in range(3))
    score = np.full(scene.shape, -1.0, np.float32)
    noise = scene.config.noise_gray
    for turn, step_px in enumerate(_STEPS_PX[: scene.config.refine_rounds]):
        fit_slopes(rho, _SURFACE_STEP, fitted, gx, gy)
        for (bounds, _), (seen, h_inf, shift) in zip(parts, warps):
            refine(gray[i], seen, h_inf, shift, fitted, gx, gy, step_px, turn == 0, noise, bounds, rho, score)
    out.correlation[i] = score
    fit_slopes(rho, _SURFACE_STEP, fitted, gx, gy)
    sharpen_edges(rho, gx, gy, score, small_color(scene.posed.images[i], scene.camera), out.rho[i])
