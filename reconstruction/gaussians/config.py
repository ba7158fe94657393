"""Settings of the Gaussians stage."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class GaussiansConfig:
    """How depth maps and images become 2D Gaussians."""

    backend: Literal["cpu", "gsplat"] = "cpu"
    """Rasterizer: `cpu` is built in; `gsplat` needs CUDA and the extra `simrecon[gpu]`."""

    iterations: int = 450
    """Gradient steps in all, one frame each."""

    side_px: int = 480
    """Longer side of the images in the last part of the training."""

    coarse_side_px: int = 320
    """Longer side of the images before that."""

    coarse_share: float = 0.6
    """Share of the iterations at the coarse size."""

    max_gaussians: int = 60_000
    """Budget: densification stops here."""

    seed_share: float = 0.75
    """Share of the budget that seeds from the depth maps may take; densification takes the rest."""

    initial_opacity: float = 0.7
    """Opacity of a seed."""

    ssim_weight: float = 0.2
    """Weight of 1 - SSIM in the color loss; the rest is L1."""

    depth_weight: float = 1.0
    """Weight of the relative difference to the depth maps."""

    completed_depth_weight: float = 0.2
    """Factor on it for completed pixels (confidence 1) beside measured ones."""

    depth_scale: float = 0.02
    """Relative depth error beyond which a pixel's pull fades, so that wrong depths do not win over images."""

    normal_weight: float = 0.03
    """Weight of 1 - cosine between the splats' normals and the normal of the rendered depth."""

    distortion_weight: float = 0.5
    """Weight of the depth distortion (spread along the ray, in relative inverse depth)."""

    opacity_weight: float = 0.05
    """Weight of light that passes where there is a surface (known depth)."""

    optimize_exposure: bool = True
    """Fit a gain and a bias per color channel to every frame."""

    optimize_poses: bool = False
    """Refine the cameras, too; kept-out frames then no longer share exactly the same space."""

    mean_rate: float = 1.2e-3
    """Adam step of the means, relative to the scene's median depth; all rates fall to `final_rate` of themselves."""

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
    """Share of every rate that is left at the end (exponential decay)."""

    densify_every: int = 60
    """Iterations between two rounds of densification and pruning."""

    densify_until: float = 0.7
    """Share of the iterations after which no Gaussian is added or removed."""

    densify_growth: float = 0.1
    """At most this share of the Gaussians is split in one round."""

    prune_opacity: float = 0.05
    """Gaussians less opaque than this are removed."""

    refine_depth: bool = True
    """Hand the depth of the Gaussians on to the later stages instead of the measured one."""

    clear_depth: float = 0.01
    """Relative difference of expected and median depth up to which a pixel shows one surface."""

    confirmed_depth: float = 0.02
    """Where it shows several: relative difference to one of the two up to which the measured depth is kept."""

    sigma_cutoff: float = 2.6
    """Standard deviations at which a splat ends."""

    transmittance_stop: float = 1e-3
    """Share of light at which a pixel is finished."""

    seed: int = 0
    """Of the order of frames and of splits."""

    def __post_init__(self) -> None:
        """Reject values that cannot work."""
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
