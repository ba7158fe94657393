"""The training loss of one frame and its gradient by the rendered image, on the CPU.

    L = (1 - w) mean |c - c*| + w (1 - mean SSIM)            color; c = gain * rendered + bias
      + w_d mean rho((z - z*) / z*)                          depth; rho(e) = s log(1 + |e| / s)
      + w_n mean (alpha - N . N_z)                           rendered normal against the normal of the rendered depth
      + w_x mean sum_{i<j} w_i w_j (m_i - m_j)^2            distortion; m = 4 z_ref / (z_ref + z)
      + w_a mean (1 - alpha)                                 opacity, where the depth is known

Means are over all pixels of the image. z is the expected depth, sum(w z) / sum(w).
"""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from reconstruction.core.types import Camera
from reconstruction.gaussians.config import GaussiansConfig
from reconstruction.gaussians.scratch import Scratch
from reconstruction.gaussians.threads import run_over

_WINDOW, _WINDOW_SIGMA = 11, 1.5


@dataclass(frozen=True)
class FrameTarget:
    """Image and depth of one frame at one resolution."""

    camera: Camera
    image: np.ndarray  # float32 (h, w, 3) RGB in [0, 1]
    depth: np.ndarray  # float32 (h, w) z-depth, 0 = unknown
    depth_weight: np.ndarray  # float32 (h, w) 0 unknown, 1 measured, less if completed

    @cached_property
    def blurred(self) -> np.ndarray:
        """The image (h, w, 3) filtered with SSIM's window."""
        return window(self.image)

    @cached_property
    def blurred_square(self) -> np.ndarray:
        """The squared image (h, w, 3) filtered with SSIM's window."""
        return window(self.image**2)

    @cached_property
    def rays(self) -> np.ndarray:
        """The rays of the pixels (h, w, 3) in the camera frame, z = 1, in the dtype of the image."""
        return self.camera.pixel_rays().astype(self.image.dtype)


@dataclass(frozen=True)
class LossWeights:
    """Weights of the terms of the loss, and the scale of the robust depth loss."""

    ssim: float
    depth: float
    depth_scale: float
    normal: float
    distortion: float
    opacity: float


@dataclass(frozen=True)
class ImageLoss:
    """The loss of one rendered frame and its gradients."""

    terms: dict[str, float]  # unweighted: l1, ssim, depth, normal, distortion, opacity
    total: float
    image_gradients: np.ndarray  # (h, w, 9) by the sums of color (3), depth, normal (3), opacity, distortion
    gain: np.ndarray  # (3,) by the exposure gain
    bias: np.ndarray  # (3,) by the exposure bias
    error: np.ndarray  # (h, w) mean absolute color difference


def weights_of(config: GaussiansConfig) -> LossWeights:
    """Return the weights of a config."""
    return LossWeights(
        config.ssim_weight, config.depth_weight, config.depth_scale, config.normal_weight, config.distortion_weight,
        config.opacity_weight,
    )  # fmt: skip


def window(image: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
    """Filter an image with SSIM's 11x11 Gaussian window and zero padding, with which the filter is self-adjoint."""
    size, border = (_WINDOW, _WINDOW), cv2.BORDER_CONSTANT
    return cv2.GaussianBlur(image, size, _WINDOW_SIGMA, dst=out, borderType=border)


def ssim(a: np.ndarray, b: np.ndarray) -> float:
    """Return the mean structural similarity of two images (h, w, 3) in [0, 1]."""
    from reconstruction.gaussians import loss_kernels

    a, b = np.ascontiguousarray(a, np.float32), np.ascontiguousarray(b, np.float32)
    row_sum, unused = np.empty(len(a)), [np.empty_like(a) for _ in range(3)]
    run_over(
        len(a), loss_kernels.ssim_partials, window(a), window(b), window(a * a), window(b * b), window(a * b), row_sum,
        *unused,
    )  # fmt: skip
    return float(row_sum.sum() / a.size)


def image_loss(
    features: np.ndarray,
    target: FrameTarget,
    gain: np.ndarray,
    bias: np.ndarray,
    weights: LossWeights,
    scratch: Scratch | None = None,
) -> ImageLoss:
    """Evaluate the loss of a rendered frame and its gradients.

    Args:
        features: (h, w, 13) of `rasterize`.
        target: the frame.
        gain: (3,) exposure gain.
        bias: (3,) exposure bias.
        weights: of the terms.
        scratch: memory for the result, which is then valid until the next call with it.
    """
    from reconstruction.gaussians import loss_kernels

    scratch, dtype = scratch or Scratch(), features.dtype
    height, width = features.shape[:2]
    pixels, shape = height * width, (height, width, 3)
    gradients = scratch.empty("image_gradients", (height, width, 9), dtype)
    names = ("color", "squares", "products", "blur_color", "blur_squares", "blur_products")
    color, squares, products, *blurred = (scratch.empty(name, shape, dtype) for name in names)
    run_over(
        height, loss_kernels.color_products, features, gain, bias, target.image, color, squares, products
    )
    mean, square, product = (window(x, out) for x, out in zip((color, squares, products), blurred))
    ssim_rows = np.empty(height)
    partials = [scratch.empty(f"partial_{i}", shape, dtype) for i in range(3)]
    run_over(
        height, loss_kernels.ssim_partials, mean, target.blurred, square, target.blurred_square, product, ssim_rows,
        *partials,
    )  # fmt: skip
    # The windowed derivatives overwrite the windowed moments.
    partials = [window(x, out) for x, out in zip(partials, blurred)]
    color_sums, error = np.empty((height, 7)), scratch.empty("error", (height, width), dtype)
    run_over(
        height, loss_kernels.color_gradients, features, color, target.image, gain, *partials,
        (1 - weights.ssim) / (3 * pixels), -weights.ssim / (3 * pixels), gradients, error, color_sums,
    )  # fmt: skip
    axes, normal_rows = scratch.empty("axes", (height, width, 6), dtype), np.empty(height)
    run_over(
        height, loss_kernels.normal_partials, features, target.rays, weights.normal / pixels, axes, gradients,
        normal_rows,
    )  # fmt: skip
    depth_sums = np.empty((height, 3))
    run_over(
        height, loss_kernels.depth_gradients, features, target.rays, target.depth, target.depth_weight, axes,
        weights.depth_scale, weights.depth / pixels, weights.opacity / pixels, weights.distortion / pixels, gradients,
        depth_sums,
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
