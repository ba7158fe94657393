"""Configuration of the world frame stage."""

from dataclasses import dataclass
from typing import Literal

from reconstruction.world.request import parse_scale
from registry.errors import UsageError


@dataclass(frozen=True, kw_only=True)
class WorldConfig:
    """How gravity, the floor and metres are found."""

    scale: str = ""
    """What the user knows, as `--scale` takes it; see `parse_scale`."""
    object_measured_height_m: float = 0.0
    """Height of the object that `scale` names, in the provisional scale; 0 until the instances are known."""
    marker_size_m: float = 0.0
    """Side of the black square of a printed ArUco or AprilTag marker in view, in metres; 0: none is used."""
    marker_dictionaries: tuple[str, ...] = (
        "DICT_APRILTAG_36h11",
        "DICT_5X5_100",
        "DICT_6X6_250",
        "DICT_4X4_50",
    )
    """The marker families looked for (names of cv2.aruco)."""
    metric_depth: Literal["none", "transformers"] = "none"
    """Learned metric depth as a source of metres; needs `pip install 'simrecon[depth-models]'`."""
    metric_depth_model: str = "depth-anything/Depth-Anything-V2-Metric-Indoor-Small-hf"
    """Model of the metric depth backend, as on the Hugging Face hub, or a local folder."""
    camera_height_prior_m: float = 1.4
    """How high people hold a camera above the floor: between chest (1.2 m) and eyes (1.6 m)."""
    camera_height_sigma: float = 0.15
    """Relative 1-sigma of that."""
    table_height_prior_m: float = 0.74
    """Height of a table, for videos that see a table top but no floor."""
    subject_distance_prior_m: float = 1.0
    """Median distance from which people film a thing, for videos without any horizontal surface."""
    max_frames: int = 48
    """How many keyframes are looked at."""
    samples_per_frame: int = 4000
    """How many oriented points are taken from each."""

    def __post_init__(self) -> None:
        """Check what a user may have typed."""
        if self.scale:
            parse_scale(self.scale)
        if self.marker_size_m < 0 or self.marker_size_m > 5:
            raise UsageError(
                f"marker size {self.marker_size_m:g} m: give the side of the black square in metres"
            )


WORLD_PRESETS = {
    "fast": WorldConfig(max_frames=24, samples_per_frame=3000),
    "default": WorldConfig(),
    "quality": WorldConfig(max_frames=96, samples_per_frame=6000),
}
