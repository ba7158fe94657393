"""The training loss of `losses` in torch, for rasterizers that use its automatic differentiation."""

from dataclasses import dataclass

import torch
import torch.nn.functional as F

from reconstruction.gaussians.losses import LossWeights

MIN_ALPHA, EDGE = 0.2, 0.05  # as in loss_kernels, whose import needs Numba


@dataclass(frozen=True)
class TorchImage:
    """A rendered image before exposure."""

    color: torch.Tensor  # (h, w, 3)
    depth: torch.Tensor  # (h, w) expected z-depth sum(w z) / sum(w)
    normal: torch.Tensor  # (h, w, 3) sum of w n in the camera frame
    alpha: torch.Tensor  # (h, w)
    distortion: torch.Tensor  # (h, w)


@dataclass(frozen=True)
class TorchTarget:
    """Image and depth of one frame, see `FrameTarget`."""

    image: torch.Tensor  # (h, w, 3)
    depth: torch.Tensor  # (h, w)
    depth_weight: torch.Tensor  # (h, w)
    rays: torch.Tensor  # (h, w, 3)


def _window(image: torch.Tensor) -> torch.Tensor:
    """Filter an image (h, w, 3) with SSIM's 11x11 Gaussian window and zero padding."""
    x = torch.arange(11, dtype=image.dtype, device=image.device) - 5
    kernel = torch.exp(-0.5 * (x / 1.5) ** 2)
    kernel = kernel / kernel.sum()
    planes = image.permute(2, 0, 1)[:, None]
    planes = F.conv2d(planes, kernel.view(1, 1, 11, 1), padding=(5, 0))
    return F.conv2d(planes, kernel.view(1, 1, 1, 11), padding=(0, 5))[:, 0].permute(1, 2, 0)


def ssim_map(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Return the structural similarity (h, w, 3) of images (h, w, 3) in [0, 1]."""
    mean_a, mean_b = _window(a), _window(b)
    variance_a, variance_b = _window(a * a) - mean_a**2, _window(b * b) - mean_b**2
    covariance = _window(a * b) - mean_a * mean_b
    c1, c2 = 0.0001, 0.0009
    return ((2 * mean_a * mean_b + c1) * (2 * covariance + c2)) / (
        (mean_a**2 + mean_b**2 + c1) * (variance_a + variance_b + c2)
    )


def _normal_term(image: TorchImage, rays: torch.Tensor) -> torch.Tensor:
    """Return the sum over pixels of alpha minus rendered normal dot normal of the rendered depth."""
    points = image.depth[..., None] * rays
    dx, dy = points[1:-1, 2:] - points[1:-1, :-2], points[2:, 1:-1] - points[:-2, 1:-1]
    cross = torch.linalg.cross(dy, dx)
    around = [image.depth[1:-1, 2:], image.depth[1:-1, :-2], image.depth[2:, 1:-1], image.depth[:-2, 1:-1]]
    stacked = torch.stack(around)
    solid = image.alpha >= MIN_ALPHA
    usable = solid[1:-1, 1:-1] & solid[1:-1, 2:] & solid[1:-1, :-2] & solid[2:, 1:-1] & solid[:-2, 1:-1]
    usable = usable & (stacked.amax(0) - stacked.amin(0) <= EDGE * stacked.amin(0))
    length = torch.linalg.norm(cross, dim=-1)
    usable = usable & (length >= 1e-20)
    normal = cross / length.clamp(min=1e-20)[..., None]
    cosine = (image.normal[1:-1, 1:-1] * normal).sum(-1)
    return torch.where(usable, image.alpha[1:-1, 1:-1].detach() - cosine, 0.0).sum()


def torch_loss(
    image: TorchImage, target: TorchTarget, gain: torch.Tensor, bias: torch.Tensor, weights: LossWeights
) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
    """Return the loss of one frame and its unweighted terms; see `losses` for the formulas."""
    color = gain * image.color + bias
    pixels = image.alpha.numel()
    seen = (image.alpha >= MIN_ALPHA) & (target.depth_weight > 0)
    truth = torch.where(target.depth_weight > 0, target.depth, 1.0)
    error = torch.where(seen, (image.depth - truth) / truth, 0.0).abs()
    terms = {
        "l1": (color - target.image).abs().mean(),
        "ssim": 1 - ssim_map(color, target.image).mean(),
        "depth": (target.depth_weight * weights.depth_scale * torch.log1p(error / weights.depth_scale)).sum()
        / pixels,
        "normal": _normal_term(image, target.rays) / pixels,
        "distortion": image.distortion.mean(),
        "opacity": (target.depth_weight * (1 - image.alpha)).sum() / pixels,
    }
    total = (1 - weights.ssim) * terms["l1"] + weights.ssim * terms["ssim"]
    for name in ("depth", "normal", "distortion", "opacity"):
        total = total + getattr(weights, name) * terms[name]
    return total, terms
