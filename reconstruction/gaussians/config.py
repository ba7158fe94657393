"""Settings of the Gaussians stage."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class GaussiansConfig:
    """Settings of fitting 2D Gaussians and of the depth maps rendered from them."""

    backend: Literal["cpu", "gsplat"] | str = "cpu"
    """Rasterizer: `cpu` is built in; `gsplat` needs CUDA and the extra `simrecon[gpu]`."""

    iterations: int = 450
    """Number of gradient steps, one frame each."""

    side_px: int = 480
    """Longer side of the images in the second part of the training."""

    coarse_side_px: int = 320
    """Longer side of the images in the first part of the training."""

    coarse_share: float = 0.6
    """Share of the iterations at the coarse size."""

    max_gaussians: int = 60_000
    """Largest number of Gaussians."""

    seed_share: float = 0.75
    """Share of `max_gaussians` for seeds from depth maps; densification adds the rest."""

    initial_opacity: float = 0.7
    """Opacity of a seed."""

    ssim_weight: float = 0.2
    """Weight of 1 - SSIM in the color loss; the rest is L1."""

    depth_weight: float = 1.0
    """Weight of the relative difference to the depth maps."""

    completed_depth_weight: float = 0.2
    """Depth weight of completed pixels (confidence 1) relative to measured ones."""

    depth_scale: float = 0.02
    """Scale of the robust depth loss: relative error at which its gradient has halved."""

    normal_weight: float = 0.03
    """Weight of 1 - cosine between the splats' normals and the normal of the rendered depth."""

    distortion_weight: float = 0.5
    """Weight of the depth distortion (spread along the ray, in relative inverse depth)."""

    opacity_weight: float = 0.05
    """Weight of the transmittance at pixels with known depth."""

    optimize_exposure: bool = True
    """Fit a gain and a bias per color channel to every frame."""

    optimize_poses: bool = False
    """Optimize the camera poses, too. Held-out cameras are not refined with them."""

    mean_rate: float = 1.2e-3
    """Adam step of the means, relative to the scene's median depth. All rates decay to `final_rate` of themselves."""

    quaternion_rate: float = 2.4e-2
    """Adam step of the quaternions."""

    scale_rate: float = 4.8e-2
    """Adam step of the log scales."""

    opacity_rate: float = 0.12
    """Adam step of the opacity logits."""

    color_rate: float = 6e-2
    """Adam step of the colors (SH degree 0)."""

    exposure_rate: float = 5e-3
    """Adam step of gains and biases."""

    pose_rate: float = 3e-4
    """Adam step of the cameras: radians, and relative to the median depth."""

    final_rate: float = 0.05
    """Final value of every rate relative to its first (exponential decay)."""

    densify_every: int = 60
    """Iterations between two rounds of densification and pruning."""

    densify_until: float = 0.7
    """Share of the iterations after which no Gaussian is added or removed."""

    densify_growth: float = 0.1
    """Largest share of the Gaussians that is split in one round."""

    prune_opacity: float = 0.05
    """Gaussians with less opacity are removed."""

    refine_depth: bool = True
    """Pass the depth rendered from the Gaussians to later stages instead of the measured depth."""

    clear_depth: float = 0.01
    """Largest relative difference of expected and median depth at pixels that show a single surface."""

    confirmed_depth: float = 0.02
    """Largest relative difference of the measured depth to expected or median depth at which it is kept."""

    sigma_cutoff: float = 2.6
    """Standard deviations at which a splat ends."""

    transmittance_stop: float = 1e-3
    """Transmittance below which a pixel is finished."""

    seed: int = 0
    """Random seed of the order of frames."""

    def __post_init__(self) -> None:
        """Reject invalid values."""
        positive = ("iterations", "side_px", "coarse_side_px", "max_gaussians", "densify_every")
        for name in positive:
            if getattr(self, name) < 1:
                raise ValueError(f"gaussians.{name} must be at least 1, not {getattr(self, name)}")
        for name in ("coarse_share", "seed_share", "densify_until", "densify_growth"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"gaussians.{name} must lie in [0, 1], not {getattr(self, name)}")
        if not 0.0 < self.initial_opacity < 1.0:
            raise ValueError(f"gaussians.initial_opacity must lie in (0, 1), not {self.initial_opacity}")


GAUSSIANS_PRESETS: dict[str, GaussiansConfig] = {
    "fast": GaussiansConfig(iterations=250, side_px=320, coarse_side_px=240, max_gaussians=30_000),
    "default": GaussiansConfig(),
    "quality": GaussiansConfig(iterations=2000, side_px=640, max_gaussians=120_000),
}
