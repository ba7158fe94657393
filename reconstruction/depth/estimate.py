"""Stage 3: posed keyframes -> one depth map each."""

from dataclasses import replace

import numpy as np

from reconstruction.core.progress import NO_PROGRESS, Progress
from reconstruction.core.types import DepthMaps, PosedFrames
from reconstruction.core.workers import Workers
from reconstruction.depth.agreement import fill_predicted, keep_confirmed
from reconstruction.depth.config import DepthConfig
from reconstruction.depth.edge_placement import place_edges
from reconstruction.depth.evidence import PREDICTED, Evidence, inverse
from reconstruction.depth.images import sized_camera
from reconstruction.depth.measure import measure_depth
from reconstruction.depth.monocular import MonocularBackend, fill_from_predictions, load_monocular
from reconstruction.depth.perturb import perturbed
from reconstruction.depth.scene import DepthScene
from reconstruction.depth.views import plan_views
from registry.errors import InputError

_LEAST_MEASURED = 0.02  # share of the pixels, below which the video is refused


def estimate_depth(
    posed: PosedFrames,
    config: DepthConfig,
    *,
    backend: MonocularBackend | None = None,
    progress: Progress = NO_PROGRESS,
) -> DepthMaps:
    """Estimate one depth map for every posed keyframe, in the units of the poses.

    Measure, keep what other views confirm, complete, place edges (`gather_evidence`); then mend the maps with the
    network of `depth.prior`.

    Args:
        posed: keyframes with cameras and sparse points, in any space and scale.
        config: settings.
        backend: learned depth of single images for what is left unknown; None: the one that `config.monocular` names.
        progress: told steps and decisions.

    Raises:
        InputError: too little can be measured, or the camera did not move sideways.
        EnvironmentMissing: weights or a model that the config asks for are missing.
    """
    backend = backend or load_monocular(config)  # a missing model is reported before the work, not after it
    found = gather_evidence(posed, config, backend=backend, progress=progress)
    if config.prior != "none":
        from reconstruction.depth.mending import drop_unconfirmed, mend_depth

        each = Workers(config.threads).each
        mended = mend_depth(found, posed, config.mend_surety, each, progress)
        found = drop_unconfirmed(mended, found.depth, posed, config.min_agreeing, each, progress)
    maps = found.maps()
    return replace(maps, depth=perturbed(maps.depth, config.perturb)) if config.perturb else maps


def gather_evidence(
    posed: PosedFrames,
    config: DepthConfig,
    *,
    backend: MonocularBackend | None = None,
    keep_agreed: bool = False,
    progress: Progress = NO_PROGRESS,
) -> Evidence:
    """Measure every keyframe and complete it by planes and predictions; return the maps with each pixel's origin.

    Args:
        posed: as of `estimate_depth`, like all others.
        config: settings.
        backend: learned depth of single images, or None.
        keep_agreed: keep the maps before completion, too (`Evidence.agreed`).
        progress: told steps and decisions.
    """
    camera = sized_camera(posed.camera, config.depth_side_px)
    scene = DepthScene(posed, camera, plan_views(posed, config), config, progress)
    measured = measure_depth(scene)
    raw = inverse(measured.rho)
    depth = keep_confirmed(scene, raw, measured.correlation)
    agreed = depth.copy() if keep_agreed else np.zeros(0, np.float32)
    confidence = np.where(depth > 0, 2, 0).astype(np.uint8)
    share = float((confidence == 2).mean())
    if share < _LEAST_MEASURED:
        raise InputError(
            f"depth: only {100 * share:.1f} % of the pixels could be measured. The frames are blurred, blank or do "
            "not move sideways: film textured things with steady sideways motion and enough light."
        )
    if config.complete:
        from reconstruction.depth.complete import complete_depth

        depth, confidence = complete_depth(scene, depth, raw)
    if config.edge_rounds > 0:
        depth, confidence = place_edges(scene, depth, confidence, measured.correlation)
    filled = np.zeros(depth.shape, bool)
    if len(measured.predicted):
        unknown = depth == 0
        depth, confidence = fill_predicted(scene, measured.predicted, measured.surety, depth, confidence)
        filled = unknown & (depth > 0)
    if backend is not None:
        depth, confidence = fill_from_predictions(scene, depth, confidence, backend)
    progress.note(
        f"depth: {100 * share:.0f} % of the pixels measured, {100 * float((confidence == 1).mean()):.0f} % completed"
    )
    origin = np.where(filled, PREDICTED, confidence).astype(np.uint8)
    return Evidence(
        camera, scene.plan.neighbors, depth, origin, measured.correlation, measured.surety, agreed
    )
