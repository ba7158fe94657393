"""The training loss of one frame and its derivatives by the rendered image, on the CPU.

    L = (1 - w) mean |c - c*| + w (1 - mean SSIM)            color; c = gain * rendered + bias
      + w_d mean rho((z - z*) / z*)                          depth; rho(e) = s log(1 + |e| / s)
      + w_n mean (alpha - N . N_z)                           rendered normal against the normal of the rendered depth
      + w_x mean sum_{i<j} w_i w_j (1/z_i - 1/z_j)^2 z_ref^2 distortion
      + w_a mean (1 - alpha)                                 opacity, where the depth is known

Means are over all pixels of the image. z is the expected depth, sum(w z) / sum(w).
"""

from dataclasses import dataclass

import cv2
import numpy as np

from reconstruction.gaussians.config import GaussiansConfig
from reconstruction.gaussians.seeding import rays_of
from reconstruction.types import Camera

_WINDOW, _WINDOW_SIGMA = 11, 1.5


@dataclass(frozen=True)
class FrameTarget:
    """What one frame at one resolution should look like."""

    camera: Camera
    image: np.ndarray  # float32 (h, w, 3) in [0, 1]
    depth: np.ndarray  # float32 (h, w), 0 unknown
    depth_weight: np.ndarray  # float32 (h, w): 0 unknown, 1 measured, less where completed


@dataclass(frozen=True)
class LossWeights:
    """Weights of the terms of the loss."""

    ssim: float
    depth: float
    depth_scale: float
    normal: float
    distortion: float
    opacity: float


@dataclass(frozen=True)
class ImageLoss:
    """The loss of one rendered frame and its derivatives."""

    terms: dict[str, float]  # unweighted: l1, ssim, depth, normal, distortion, opacity
    total: float
    image_gradients: np.ndarray  # (h, w, 9) by color, depth, normal, opacity, distortion sums
    gain: np.ndarray  # (3,) derivative by the exposure's gain
    bias: np.ndarray  # (3,)
    error: np.ndarray  # (h, w) mean absolute color difference


def weights_of(config: GaussiansConfig) -> LossWeights:
    """Return the weights that a config asks for."""
    return LossWeights(
        config.ssim_weight, config.depth_weight, config.depth_scale, config.normal_weight,
        config.distortion_weight, config.opacity_weight,
    )  # fmt: skip


def window(image: np.ndarray) -> np.ndarray:
    """Blur with SSIM's 11x11 Gaussian window; zero outside, which makes the operation its own adjoint."""
    return cv2.GaussianBlur(image, (_WINDOW, _WINDOW), _WINDOW_SIGMA, borderType=cv2.BORDER_CONSTANT)


def ssim(a: np.ndarray, b: np.ndarray) -> float:
    """Return the mean structural similarity of two images (h, w, 3) in [0, 1]."""
    from reconstruction.gaussians import loss_kernels

    a, b = np.ascontiguousarray(a, np.float32), np.ascontiguousarray(b, np.float32)
    row_sum, unused = np.empty(len(a)), [np.empty_like(a) for _ in range(3)]
    loss_kernels.ssim_partials(
        window(a), window(b), window(a * a), window(b * b), window(a * b), row_sum, *unused
    )
    return float(row_sum.sum() / a.size)


def image_loss(
    features: np.ndarray, target: FrameTarget, gain: np.ndarray, bias: np.ndarray, weights: LossWeights
) -> ImageLoss:
    """Evaluate the loss of a rendered frame.

    Args:
        features: (h, w, 13) of `rasterize`, float32.
        target: The frame.
        gain: (3,) exposure; bias alike.
        weights: Of the terms.
    """
    from reconstruction.gaussians import loss_kernels

    height, width = features.shape[:2]
    pixels = height * width
    gradients = np.empty((height, width, 9), features.dtype)
    color = features[..., :3] * gain.astype(features.dtype) + bias.astype(features.dtype)
    squares, products = np.empty_like(color), np.empty_like(color)
    loss_kernels.ssim_statistics(color, target.image, squares, products)
    moments = [window(x) for x in (color, target.image, squares, target.image**2, products)]
    partials = [np.empty_like(color) for _ in range(3)]
    ssim_rows = np.empty(height)
    loss_kernels.ssim_partials(*moments, ssim_rows, *partials)
    partials = [window(x) for x in partials]
    color_sums, error = np.empty((height, 7)), np.empty((height, width), features.dtype)
    loss_kernels.color_gradients(
        features, color, target.image, gain, *partials, (1 - weights.ssim) / (3 * pixels),
        -weights.ssim / (3 * pixels), gradients, error, color_sums,
    )  # fmt: skip
    rays = rays_of(target.camera, features.dtype)
    axes, normal_rows = np.empty((height, width, 6), features.dtype), np.empty(height)
    loss_kernels.normal_partials(features, rays, weights.normal / pixels, axes, gradients, normal_rows)
    depth_sums = np.empty((height, 3))
    loss_kernels.depth_gradients(
        features, rays, target.depth, target.depth_weight, axes, weights.depth_scale, weights.depth / pixels,
        weights.opacity / pixels, weights.distortion / pixels, gradients, depth_sums,
    )  # fmt: skip
    color_total, depth_total = color_sums.sum(axis=0), depth_sums.sum(axis=0) / pixels
    terms = {
        "l1": float(color_total[0] / (3 * pixels)),
        "ssim": float(1 - ssim_rows.sum() / (3 * pixels)),
        "depth": float(depth_total[0]),
        "normal": float(normal_rows.sum() / pixels),
        "distortion": float(depth_total[2]),
        "opacity": float(depth_total[1]),
    }
    total = (1 - weights.ssim) * terms["l1"] + weights.ssim * terms["ssim"]
    total += sum(getattr(weights, k) * terms[k] for k in ("depth", "normal", "distortion", "opacity"))
    return ImageLoss(terms, total, gradients, color_total[1:4], color_total[4:7], error)
