"""Fit Gaussians to posed frames and depth maps: the training loop.

One frame per step, in a seeded random order; small images first. All lengths are relative to the scene's median depth,
so that the result does not depend on the scale of the input.
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np

from reconstruction.core.progress import NO_PROGRESS, Progress
from reconstruction.core.types import DepthMaps, PosedFrames
from reconstruction.gaussians.backend import Backend
from reconstruction.gaussians.backends import load_backend
from reconstruction.gaussians.config import GaussiansConfig
from reconstruction.gaussians.hole_seeding import fill_holes
from reconstruction.gaussians.losses import FrameTarget, weights_of
from reconstruction.gaussians.model import Gaussians, from_packed
from reconstruction.gaussians.optimizer import Adam, SplatState, prune, rates_of, split
from reconstruction.gaussians.rasterizer import RasterSettings
from reconstruction.gaussians.seeding import seed_from_depth
from registry.errors import InputError

_REPORT_EVERY = 10  # iterations
_EXPOSURE_SIDE = 96  # longer side in pixels of the images whose mean colors give the first gains
_EXPOSURE_PULL = (
    1e-3  # weight of the pull to gain 1 and bias 0, since colors and exposures share a free factor
)


@dataclass
class _Cameras:
    """Variables per frame, and their optimizers."""

    gain: np.ndarray  # float64 (k, 3)
    bias: np.ndarray  # float64 (k, 3)
    poses: np.ndarray  # float64 (k, 4, 4) world_from_camera
    adam_exposure: Adam
    adam_pose: Adam


def median_depth_of(depth: DepthMaps) -> float:
    """Return the median known depth of about 16 frames, the unit of length of the fit.

    Raises:
        InputError: no pixel is known.
    """
    stride = max(1, len(depth.depth) // 16)
    known = np.asarray(depth.depth[::stride])[np.asarray(depth.confidence[::stride]) > 0]
    if len(known) == 0:
        raise InputError("gaussians: no depth map has a known pixel, so there is nothing to fit to")
    return float(np.median(known))


def settings_of(config: GaussiansConfig, median_depth: float) -> RasterSettings:
    """Return the rasterizer's settings for a scene with a certain median depth."""
    return RasterSettings(
        sigma_cutoff=config.sigma_cutoff,
        transmittance_stop=config.transmittance_stop,
        near=0.02 * median_depth,
        reference_depth=median_depth,
    )


def make_target(posed: PosedFrames, depth: DepthMaps, row: int, side: int, completed: float) -> FrameTarget:
    """Return image and depth of frame `row`, resized to at most `side` pixels; `completed` weighs completed depth."""
    full = posed.camera
    scale = min(1.0, side / max(full.width, full.height))
    width, height = round(full.width * scale), round(full.height * scale)
    image = cv2.resize(np.asarray(posed.images[row]), (width, height), interpolation=cv2.INTER_AREA)
    # Nearest neighbor: depth must not be mixed across occlusion boundaries.
    z, confidence = (
        cv2.resize(np.asarray(maps[row]), (width, height), interpolation=cv2.INTER_NEAREST)
        for maps in (depth.depth, depth.confidence)
    )
    weight = np.choose(np.minimum(confidence, 2), [0.0, completed, 1.0]).astype(np.float32) * (z > 0)
    return FrameTarget(full.resized(width, height), image.astype(np.float32) / 255, z, weight)


def fit_gaussians(
    posed: PosedFrames, depth: DepthMaps, config: GaussiansConfig, *, progress: Progress = NO_PROGRESS
) -> Gaussians:
    """Fit 2D Gaussians to frames and depth maps.

    Args:
        posed: keyframes with cameras, in any space; held-out frames are not used.
        depth: one depth map per keyframe, in the same units.
        config: settings; the result is deterministic.
        progress: receives steps and a summary.

    Returns:
        The Gaussians with the exposures (and cameras) of the keyframes.

    Raises:
        InputError: there is no usable depth.
        EnvironmentMissing: the backend's requirements are not met.
    """
    backend = load_backend(config.backend)
    unit = median_depth_of(depth)
    settings = settings_of(config, unit)
    budget = int(config.seed_share * config.max_gaussians)
    seeds = seed_from_depth(posed, depth, budget, config.initial_opacity)
    state = SplatState.start(seeds)
    frames = len(posed.images)
    cameras = _Cameras(
        np.ones((frames, 3)), np.zeros((frames, 3)), np.array(posed.world_from_camera, np.float64),
        Adam((frames, 6)), Adam((frames, 6)),
    )  # fmt: skip
    rng = np.random.default_rng(config.seed)
    progress.start(config.iterations, "fitting Gaussians")
    if config.optimize_exposure:
        cameras.gain[:] = _first_gains(backend, state, posed, depth, settings)
    coarse_until = round(config.coarse_share * config.iterations)
    added = 0
    order: list[int] = []
    targets: dict[int, FrameTarget] = {}
    for step in range(config.iterations):
        side = config.coarse_side_px if step < coarse_until else config.side_px
        if step in (0, coarse_until):
            targets.clear()
        if not order:
            order = rng.permutation(frames).tolist()
        row = order.pop()
        if row not in targets:
            targets[row] = make_target(posed, depth, row, side, config.completed_depth_weight)
        if step == 0:
            added += _fill(backend, state, cameras, posed, depth, config, settings)
        _take_step(
            backend, state, cameras, row, targets[row], config, settings, unit, step / config.iterations
        )
        done = step + 1
        if done % config.densify_every == 0:
            if done <= config.densify_until * config.iterations:
                prune(state, config)
                added += split(state, config)
            state.forget_tally()
        if done % _REPORT_EVERY == 0:
            progress.advance(_REPORT_EVERY)
    progress.note(
        f"gaussians: {len(state)} Gaussians: {len(seeds)} seeded from depth, {added} added by hole filling and splits"
    )
    return from_packed(
        state.parameters, cameras.gain.astype(np.float32), cameras.bias.astype(np.float32), cameras.poses
    )


def _first_gains(
    backend: Backend, state: SplatState, posed: PosedFrames, depth: DepthMaps, settings: RasterSettings
) -> np.ndarray:
    """Return gains (k, 3): each frame's mean color relative to that of the rendered seeds; geometric mean 1."""
    gains = np.ones((len(posed.images), 3))
    for row, pose in enumerate(posed.world_from_camera):
        target = make_target(posed, depth, row, _EXPOSURE_SIDE, 1.0)
        render = backend.render(state.parameters, target.camera, pose, settings)
        solid = render.opacity > 0.5
        if solid.mean() > 0.1:
            color = render.color[solid] / render.opacity[solid, None]
            gains[row] = target.image[solid].mean(axis=0) / np.maximum(color.mean(axis=0), 0.02)
    return np.clip(gains / np.exp(np.log(gains).mean(axis=0)), 0.3, 3.0)


def _fill(
    backend: Backend, state: SplatState, cameras: _Cameras, posed: PosedFrames, depth: DepthMaps,
    config: GaussiansConfig, settings: RasterSettings,
) -> int:  # fmt: skip
    """Add Gaussians in holes of the rendered seeds, where no depth map has depth; return their number."""
    before = len(state)
    for row in range(0, len(posed.images), max(1, len(posed.images) // 24)):
        room = int(0.95 * config.max_gaussians) - len(state)
        if room <= 0:
            break
        target = make_target(posed, depth, row, config.coarse_side_px, config.completed_depth_weight)
        render = backend.render(state.parameters, target.camera, cameras.poses[row], settings)
        new = fill_holes(render, target, cameras.poses[row])
        state.append(new[:room])
    return len(state) - before


def _take_step(
    backend: Backend, state: SplatState, cameras: _Cameras, row: int, target: FrameTarget, config: GaussiansConfig,
    settings: RasterSettings, unit: float, share_done: float,
) -> None:  # fmt: skip
    """Evaluate the loss of frame `row` and step Gaussians, exposure and pose."""
    gain, bias, pose = cameras.gain[row], cameras.bias[row], cameras.poses[row]
    result = backend.step(state.parameters, pose, target, gain, bias, weights_of(config), settings)
    rates = rates_of(config, unit, share_done)
    limits = np.log(np.array([0.1, 60.0]) * 0.001 * unit)
    state.update(result.parameters, result.rows, rates, limits)
    state.tally(result.rows, result.depths, target.camera.fx, result.contribution, result.error)
    fade = config.final_rate**share_done
    if config.optimize_exposure:
        pull = _EXPOSURE_PULL * np.concatenate([gain - 1, bias])
        change = cameras.adam_exposure.step(
            row, np.concatenate([result.gain, result.bias]) + pull, config.exposure_rate * fade
        )
        cameras.gain[row] = gain + change[:3]
        cameras.bias[row] = bias + change[3:]
    if config.optimize_poses:
        scale = np.array([unit, unit, unit, 1, 1, 1])
        change = cameras.adam_pose.step(row, result.pose * scale, config.pose_rate * fade) * scale
        cameras.poses[row] = pose @ exponential(change)


def exponential(xi: np.ndarray) -> np.ndarray:
    """Return the exponential map (4, 4) of a twist (6,): translation, then rotation."""
    w = np.asarray(xi[3:], np.float64)
    angle = float(np.linalg.norm(w))
    k = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
    if angle < 1e-6:
        a, b, c = 1.0, 0.5, 1.0 / 6
    else:
        a, b, c = (
            math.sin(angle) / angle,
            (1 - math.cos(angle)) / angle**2,
            (angle - math.sin(angle)) / angle**3,
        )
    out = np.eye(4)
    out[:3, :3] += a * k + b * (k @ k)
    out[:3, 3] = (np.eye(3) + b * k + c * (k @ k)) @ xi[:3]
    return out
