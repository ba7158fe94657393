"""Settings of active viewpoint optimization."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class AvoConfig:
    """Settings of viewpoint selection and optimization."""

    strategy: Literal["avo", "avo-no-depth", "max-visibility", "canonical"] | str = "avo"
    """`avo`: optimized viewpoints; `avo-no-depth`: the same without the depth term; `max-visibility`: the input frames
    that see most; `canonical`: an orbit around the target that ignores the room."""

    views: int = 4
    """K: largest number of views of a target."""

    remaining_share: float = 0.05
    """Eta: stop when the remaining effective opacity falls below this share of the target's opacity."""

    min_gain: float = 0.003
    """Stop when the next view would newly show less than this share of the target's opacity."""

    back_weight: float = 0.5
    """Weight of the back of a Gaussian relative to its front. Backs show through unseen sides of an object. Such a view
    helps to inspect a completed shape, but its picture shows a shell from within. 0: no such views."""

    side_px: int = 96
    """Side of the square image during optimization."""

    scan_side_px: int = 64
    """Side of the image that tells fronts from backs (input cameras, zoomed in), and of images of large targets."""

    fov_deg: float = 50.0
    """Field of view of optimized and canonical views."""

    fill: float = 0.8
    """Share of the field of view that the target's bounding sphere fills at the target distance."""

    min_distance_m: float = 0.35
    """Smallest target distance. Closer views resolve single Gaussians of small objects."""

    depth_weight: float = 20.0
    """Lambda: weight of the squared relative difference to the target distance. Information is measured relative to the
    best start."""

    steps: int = 15
    """Gradient steps per view."""

    rate: float = 0.06
    """Initial step size: radians around the target, and relative to its distance. Decays to a tenth along a cosine."""

    free_weight: float = 1.0
    """Weight of the squared relative shortfall below `clearance_m`."""

    clearance_m: float = 0.08
    """Distance to surfaces and unobserved space below which a camera is penalized."""

    min_clearance_m: float = 0.04
    """Smallest distance of a camera to surfaces and unobserved space."""

    max_pitch_deg: float = 80.0
    """Largest pitch up or down; cameras have no roll."""

    starts: Literal["input", "around"] = "around"
    """Start poses: `input` at the input camera that sees most of the unseen part, as in the paper; `around` also at
    positions around the target in free space."""

    restarts: int = 2
    """Number of best starts that are optimized for a third of the steps; the best of them is continued."""

    large_gaussians: int = 2000
    """Targets with more Gaussians (tables, shelves) are optimized at `scan_side_px`, with two thirds of the steps and
    at most this many Gaussians, to bound time. 0: never."""

    sigma_cutoff: float = 3.5
    """Standard deviations at which a splat ends during optimization: a hard edge would bias the gradient."""

    alpha_min: float = 1e-4
    """Alpha at which a splat ends during optimization."""

    transmittance_stop: float = 1e-4
    """Transmittance below which a pixel is finished during optimization."""

    picture_side_px: int = 256
    """Longer side of the returned pictures."""

    inpainting: Literal["telea", "navier-stokes"] | str = "telea"
    """Inpainting of pixels that no Gaussian covers after occluders are removed (OpenCV)."""

    def __post_init__(self) -> None:
        """Reject invalid values."""
        for name in ("views", "side_px", "scan_side_px", "picture_side_px", "restarts"):
            if getattr(self, name) < 1:
                raise ValueError(f"avo.{name} must be at least 1, not {getattr(self, name)}")
        for name in ("fill", "remaining_share", "min_gain"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"avo.{name} must lie in [0, 1], not {getattr(self, name)}")
        if not 5.0 <= self.fov_deg <= 140.0:
            raise ValueError(f"avo.fov_deg must lie in [5, 140], not {self.fov_deg}")


AVO_PRESETS = {
    "fast": AvoConfig(views=3, steps=9),
    "default": AvoConfig(),
    "quality": AvoConfig(side_px=128, steps=24, restarts=3, large_gaussians=0, picture_side_px=512),
}
