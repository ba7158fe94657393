"""Evaluate Gaussians on held-out frames: PSNR, SSIM, depth error, coverage."""

from dataclasses import dataclass

import cv2
import numpy as np

from reconstruction.core.types import PosedFrames
from reconstruction.gaussians.losses import ssim
from reconstruction.gaussians.model import Gaussians
from reconstruction.gaussians.rasterizer import RasterSettings
from reconstruction.gaussians.views import render_gaussians


@dataclass(frozen=True)
class GaussiansEvaluation:
    """Metrics per held-out frame, after fitting a gain and a bias per color channel."""

    indices: np.ndarray  # int32 (m,) video frame numbers
    psnr_db: np.ndarray  # float64 (m,)
    ssim: np.ndarray  # float64 (m,)
    depth_error: (
        np.ndarray
    )  # float64 (m,) median relative error of the expected depth, NaN without ground truth
    coverage: np.ndarray  # float64 (m,) share of pixels with opacity above 0.5

    @property
    def mean_psnr_db(self) -> float:
        """Return the mean over the frames."""
        return float(self.psnr_db.mean()) if len(self.psnr_db) else float("nan")

    @property
    def mean_ssim(self) -> float:
        """Return the mean over the frames."""
        return float(self.ssim.mean()) if len(self.ssim) else float("nan")

    @property
    def median_depth_error(self) -> float:
        """Return the median over the frames."""
        return float(np.median(self.depth_error)) if len(self.depth_error) else float("nan")


def fit_exposure(rendered: np.ndarray, image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fit gain (3,) and bias (3,) from a rendered image (h, w, 3) to a photograph by least squares."""
    gain, bias = np.ones(3), np.zeros(3)
    for c in range(3):
        a, b = rendered[..., c].ravel().astype(np.float64), image[..., c].ravel().astype(np.float64)
        variance = a.var()
        gain[c] = ((a - a.mean()) * (b - b.mean())).mean() / variance if variance > 1e-8 else 1.0
        bias[c] = b.mean() - gain[c] * a.mean()
    return gain, bias


def psnr_db(a: np.ndarray, b: np.ndarray) -> float:
    """Return the peak signal-to-noise ratio of images in [0, 1], in dB, at most 100."""
    return float(-10 * np.log10(max(float(np.mean((a.astype(np.float64) - b) ** 2)), 1e-10)))


def evaluate_gaussians(
    gaussians: Gaussians,
    posed: PosedFrames,
    depth_truth: np.ndarray | None = None,
    *,
    side_px: int = 0,
    settings: RasterSettings | None = None,
    backend: str = "cpu",
) -> GaussiansEvaluation:
    """Render the held-out frames and compare them with the images over all pixels.

    Args:
        gaussians: in the space of `posed`.
        posed: its held-out frames are used.
        depth_truth: (m, h, w) true z-depth of the held-out frames, 0 unknown, at any resolution.
        side_px: longer side to compare at; 0: that of the frames.
        settings: of the rasterizer.
        backend: as `GaussiansConfig.backend`.
    """
    full = posed.camera
    scale = min(1.0, side_px / max(full.width, full.height)) if side_px else 1.0
    camera = full.resized(round(full.width * scale), round(full.height * scale))
    count = len(posed.held_out_images)
    out = {name: np.full(count, np.nan) for name in ("psnr_db", "ssim", "depth_error", "coverage")}
    for row in range(count):
        pose = posed.held_out_world_from_camera[row]
        size = (camera.width, camera.height)
        image = cv2.resize(np.asarray(posed.held_out_images[row]), size, interpolation=cv2.INTER_AREA)
        image = image.astype(np.float32) / 255
        render = render_gaussians(gaussians, camera, pose, settings=settings, backend=backend)
        gain, bias = fit_exposure(render.color, image)
        color = np.clip(render.color * gain + bias, 0, 1)
        out["psnr_db"][row], out["ssim"][row] = psnr_db(color, image), ssim(color, image)
        out["coverage"][row] = float((render.opacity > 0.5).mean())
        if depth_truth is not None:
            exact = np.asarray(depth_truth[row], np.float32)
            truth = cv2.resize(exact, size, interpolation=cv2.INTER_NEAREST)
            both = (truth > 0) & (render.opacity > 0.5)
            if both.any():
                out["depth_error"][row] = np.median(np.abs(render.depth[both] / truth[both] - 1))
    return GaussiansEvaluation(indices=np.asarray(posed.held_out_indices, np.int32), **out)
