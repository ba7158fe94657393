"""Settings of active viewpoint optimization."""

from dataclasses import dataclass
from typing import Literal

Strategy = Literal["avo", "avo-no-depth", "max-visibility", "canonical"]


@dataclass(frozen=True)
class AvoConfig:
    """How views of a target are chosen."""

    strategy: Strategy = "avo"
    """`avo`: optimized viewpoints; `avo-no-depth`: the same without the depth term; `max-visibility`: the input frames
    that see most; `canonical`: an orbit around the target that knows nothing of the room."""

    views: int = 4
    """K: views of a target, at most."""

    remaining_share: float = 0.05
    """Eta: no further view once the effective opacity that is left falls under this share of the target's opacity."""

    min_gain: float = 0.003
    """No further view that would show less than this share of the target's opacity anew."""

    back_weight: float = 0.5
    """What the back of a Gaussian counts beside its front. Backs show through sides of a thing that no frame saw: the
    view is where a completed shape can be looked at, but its picture shows a shell from within. 0: no such views."""

    side_px: int = 96
    """Side of the square picture that is optimized."""

    scan_side_px: int = 64
    """Side of the pictures in which input cameras, zoomed in, tell fronts from backs, and of those of large targets."""

    fov_deg: float = 50.0
    """Field of view of optimized and canonical views."""

    fill: float = 0.8
    """The target distance shows the sphere around the target in this share of the field of view."""

    min_distance_m: float = 0.35
    """The target distance is at least this: nearer, small things show their Gaussians and the camera is in the way."""

    depth_weight: float = 20.0
    """Lambda: of the squared difference to the target distance, relative to it. Information counts as a share of
    what the best start shows."""

    steps: int = 15
    """Gradient steps of a view."""

    rate: float = 0.06
    """First step: radians around the target, and relative to its distance; falls to a tenth along a cosine."""

    free_weight: float = 1.0
    """Of the squared shortfall of the clearance, relative to it."""

    clearance_m: float = 0.08
    """Cameras are pushed away from what is nearer than this: surfaces and space that no frame looked into."""

    min_clearance_m: float = 0.04
    """No camera is nearer than this to it."""

    max_pitch_deg: float = 80.0
    """Steepest view up or down; cameras are upright."""

    starts: Literal["input", "around"] = "around"
    """Where views start: `input` at the input camera that sees most of what is left, as in the paper; `around` also at
    places around the target in free space, where one of them is better."""

    restarts: int = 2
    """How many of the best starts are followed for a third of the steps of a view; the best of them goes on."""

    large_gaussians: int = 2000
    """Targets of more Gaussians than this (tables, shelves) are optimized at `scan_side_px`, with two thirds of the
    steps and through no more Gaussians than this: their Gaussians are what takes time. 0: never."""

    sigma_cutoff: float = 3.5
    """Standard deviations at which a splat ends while views are optimized: a hard edge would falsify the gradient."""

    alpha_min: float = 1e-4
    """Alpha at which a splat ends while views are optimized."""

    transmittance_stop: float = 1e-4
    """Share of light at which a pixel is finished while views are optimized."""

    picture_side_px: int = 256
    """Side of the pictures that are returned."""

    inpainting: Literal["telea", "navier-stokes"] = "telea"
    """How what no Gaussian covers is filled once occluders are taken away (OpenCV)."""

    def __post_init__(self) -> None:
        """Reject values that cannot work."""
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
