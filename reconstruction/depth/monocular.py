"""Monocular depth of single images, aligned to measured depth -> depth of pixels that nothing else reaches.

A prediction is inverse depth up to scale and shift, which differ from image to image. RANSAC over pairs of measured
points finds them, least squares on the inliers refines them, and the smooth residual is extended into the holes. Only
unknown pixels are filled, unless other views look through them.
"""

from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np

from reconstruction.core.plugins import load_plugin
from reconstruction.core.types import Camera, PosedFrames
from reconstruction.depth.config import DepthConfig
from reconstruction.depth.scene import DepthScene
from registry.geometry import invert_rigid

_BATCH = 4
_TRIALS = 300  # pairs tried for scale and shift
_MIN_ANCHORS = 150
_INLIER = 0.06  # relative difference of inverse depth
_MIN_INLIERS = 0.5  # a prediction that fewer anchors bear out is not used
_RESIDUAL_PX = 0.05  # reach of the residual field, in image widths
_MAX_RESIDUAL = 0.1
_RELIEF = 0.04  # relative change of inverse depth between pixels beyond which predictions smear an edge
_THROUGH, _SAME = 1.05, 0.03  # other views look through a fill, or confirm it


class MonocularBackend(Protocol):
    """Predicts inverse depth from single images."""

    name: str

    def predict(self, images: list[np.ndarray]) -> list[np.ndarray]:
        """Return inverse depth up to a positive scale and a shift, float32 (h, w), of RGB images uint8 (h, w, 3)."""
        ...


class TransformersMonocular:
    """A relative or metric model through `transformers`."""

    def __init__(self, model: str) -> None:
        """Load the model."""
        from reconstruction.learned.depth_model import DepthModel

        self._model = DepthModel(model, asked_by="depth.monocular")
        self.name = model

    def predict(self, images: list[np.ndarray]) -> list[np.ndarray]:
        """See `MonocularBackend.predict`."""
        maps = self._model.predict(images)
        if self._model.predicts_metres:
            maps = [np.where(m > 1e-3, 1.0 / np.maximum(m, 1e-3), np.nan).astype(np.float32) for m in maps]
        return maps


def load_monocular(config: DepthConfig) -> MonocularBackend | None:
    """Return the backend that the config asks for, or None."""
    if config.monocular == "none":
        return None
    if config.monocular == "transformers":
        return TransformersMonocular(config.monocular_model)
    return load_plugin("depth.monocular", config.monocular, DepthConfig)(config)


@dataclass(frozen=True)
class Fit:
    """Inverse depth is about scale * prediction + shift."""

    scale: float
    shift: float
    inlier_share: float


def fit_affine(prediction: np.ndarray, rho: np.ndarray, seed: int) -> Fit | None:
    """Fit scale and shift robustly to anchors (n,); None where no positive scale suits at least half of them."""
    good = np.isfinite(prediction) & (rho > 0)
    x, y = prediction[good].astype(np.float64), rho[good].astype(np.float64)
    if len(x) < _MIN_ANCHORS or np.ptp(x) <= 1e-9 * np.abs(x).max():
        return None
    pairs = np.random.default_rng(seed).integers(0, len(x), (_TRIALS, 2))
    run = x[pairs[:, 1]] - x[pairs[:, 0]]
    pairs, run = pairs[run != 0], run[run != 0]
    scale = (y[pairs[:, 1]] - y[pairs[:, 0]]) / run
    shift = y[pairs[:, 0]] - scale * x[pairs[:, 0]]
    step = max(1, len(x) // 2000)
    error = np.abs(scale[:, None] * x[::step] + shift[:, None] - y[::step]) / y[::step]
    score = np.where(scale > 0, (error < _INLIER).sum(1), -1)
    best = int(np.argmax(score))
    if score[best] <= 0:
        return None
    a, b = scale[best], shift[best]
    for _ in range(5):
        inlier = np.abs(a * x + b - y) < _INLIER * y
        if inlier.sum() < _MIN_ANCHORS // 2:
            return None
        weight = 1.0 / y[inlier]  # relative errors count
        design = np.stack([x[inlier], np.ones(inlier.sum())], 1) * weight[:, None]
        a, b = np.linalg.lstsq(design, y[inlier] * weight, rcond=None)[0]
    share = float((np.abs(a * x + b - y) < _INLIER * y).mean())
    return Fit(float(a), float(b), share) if a > 0 and share >= _MIN_INLIERS else None


def residual_field(ratio: np.ndarray, known: np.ndarray, reach_px: float) -> np.ndarray:
    """Return the smooth field (h, w) of log(measured / predicted): near anchors theirs, far from them none."""
    size = (0, 0)
    value = np.where(known, np.clip(np.log(np.where(known, ratio, 1.0)), -_MAX_RESIDUAL, _MAX_RESIDUAL), 0.0)
    total = cv2.GaussianBlur(value.astype(np.float32), size, reach_px)
    weight = cv2.GaussianBlur(known.astype(np.float32), size, reach_px)
    return total / (weight + 0.02)


def _anchors(posed: PosedFrames, camera: Camera, i: int, depth: np.ndarray, measured: np.ndarray):
    """Return rows, columns and inverse depths of every third measured pixel and of the frame's sparse points."""
    y, x = np.nonzero(measured[1::3, 1::3])
    y, x = 3 * y + 1, 3 * x + 1
    rows = posed.observations[posed.observations[:, 0] == i, 1]
    local = invert_rigid(posed.world_from_camera[i])
    points = posed.points[rows] @ local[:3, :3].T + local[:3, 3]
    points = points[points[:, 2] > 0]
    u, v = (np.floor(values).astype(int) for values in camera.project(points))
    inside = (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
    rho = np.concatenate([1.0 / depth[y, x], 1.0 / points[inside, 2]])
    return np.concatenate([y, v[inside]]), np.concatenate([x, u[inside]]), rho


def aligned_depth(
    prediction: np.ndarray, depth: np.ndarray, measured: np.ndarray, anchors: tuple, seed: int
) -> np.ndarray | None:
    """Return depth (h, w) by the prediction, 0 where it is smeared or senseless; None where it does not fit."""
    y, x, rho = anchors
    fit = fit_affine(prediction[y, x], rho, seed)
    if fit is None:
        return None
    inverse = fit.scale * np.nan_to_num(prediction, nan=-1.0) + fit.shift
    valid = np.isfinite(prediction) & (inverse > 0.2 * rho.min()) & (inverse < 2.0 * rho.max())
    inverse = np.where(valid, inverse, 1.0)
    ratio = 1.0 / (np.maximum(depth, 1e-12) * inverse)
    known = measured & valid & (np.abs(ratio - 1.0) < 2 * _INLIER)
    inverse = inverse * np.exp(residual_field(ratio, known, _RESIDUAL_PX * prediction.shape[1]))
    log = np.log(inverse)
    dy, dx = np.gradient(log)
    smeared = cv2.dilate((np.hypot(dx, dy) > _RELIEF).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    return np.where(valid & ~smeared, 1.0 / inverse, 0.0).astype(np.float32)


def fill_from_predictions(
    scene: DepthScene, depth: np.ndarray, confidence: np.ndarray, backend: MonocularBackend
) -> tuple[np.ndarray, np.ndarray]:
    """Fill unknown pixels of depth (n, h, w) with confidence 1; measured and completed ones stay what they are."""
    from reconstruction.depth.consistency import count_witnesses

    posed, camera, progress, n = scene.posed, scene.camera, scene.progress, len(depth)
    size = (camera.width, camera.height)
    filled = depth.copy()
    failed = np.zeros(n, bool)
    progress.start(n, f"predicting depth with {backend.name}")
    for first in range(0, n, _BATCH):
        rows = range(first, min(n, first + _BATCH))
        maps = backend.predict([np.ascontiguousarray(posed.images[i]) for i in rows])
        for i, one in zip(rows, maps):
            prediction = cv2.resize(np.asarray(one, np.float32), size, interpolation=cv2.INTER_LINEAR)
            measured = confidence[i] == 2
            anchors = _anchors(posed, camera, i, depth[i], measured)
            found = aligned_depth(prediction, depth[i], measured, anchors, scene.config.seed + i)
            if found is None:
                failed[i] = True
            else:
                filled[i] = np.where(depth[i] > 0, depth[i], found)
        progress.advance(len(rows))
    out, trust = filled.copy(), confidence.copy()
    trust[(filled > 0) & (depth == 0)] = 1

    def check(i: int) -> None:
        rows, relative = scene.neighbors(i)
        agree, through = np.zeros(filled[i].shape, np.uint8), np.zeros(filled[i].shape, np.uint8)
        fresh = (depth[i] == 0) & (filled[i] > 0)
        count_witnesses(i, rows, filled, fresh, relative, camera.intrinsics, _THROUGH, _SAME, agree, through)
        drop = fresh & (through >= 2) & (through >= agree)
        out[i][drop], trust[i][drop] = 0, 0

    scene.each(check, "checking predictions")
    dropped = ((filled > 0) & (out == 0)).mean()
    progress.note(
        f"depth: {backend.name} filled {100 * ((out > 0) & (depth == 0)).mean():.1f} % of the pixels; "
        f"{100 * dropped:.1f} % were dropped because other views look through them; "
        f"{failed.sum()} of {n} frames could not be fitted to what was measured and stay as they are"
    )
    return out, trust
