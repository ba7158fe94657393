"""Settings of the world stage."""

from dataclasses import dataclass
from typing import Literal

from reconstruction.world.request import parse_scale
from registry.errors import UsageError


@dataclass(frozen=True, kw_only=True)
class WorldConfig:
    """Settings of gravity, floor and scale estimation."""

    scale: str = ""
    """A length known to the user, in the format of `--scale`; see `parse_scale`."""
    object_measured_height_m: float = 0.0
    """Height of the object that `scale` names, at the provisional scale; 0 until instances are known."""
    marker_size_m: float = 0.0
    """Side of the black square of printed ArUco or AprilTag markers in view, in metres; 0: markers are not used."""
    marker_dictionaries: tuple[str, ...] = (
        "DICT_APRILTAG_36h11", "DICT_5X5_100", "DICT_6X6_250", "DICT_4X4_50",
    )  # fmt: skip
    """Marker families to detect (names of cv2.aruco)."""
    metric_depth: Literal["none", "transformers"] | str = "none"
    """Learned metric depth as a source of metres; needs `pip install 'simrecon[depth-models]'`."""
    metric_depth_model: str = "depth-anything/Depth-Anything-V2-Metric-Indoor-Small-hf"
    """Model of the metric depth backend: its name on the Hugging Face hub, or a local folder."""
    usual_sizes: bool = False
    """Without a known length, join the camera's height with usual heights of furniture and ceilings. Right in rooms of
    standard furniture, and sure of itself and wrong where tables are much lower; see docs/world_frame.md."""
    camera_height_prior_m: float = 1.4
    """Prior of the camera height above the floor: between chest (1.2 m) and eyes (1.6 m)."""
    camera_height_sigma: float = 0.15
    """Relative standard deviation of the camera height."""
    table_height_prior_m: float = 0.74
    """Prior of the height of a table, for videos that show a table top but no floor."""
    subject_distance_prior_m: float = 1.0
    """Prior of the median distance to filmed objects, for videos without any horizontal surface."""
    max_frames: int = 48
    """Number of keyframes to sample, at most."""
    samples_per_frame: int = 4000
    """Number of oriented points per sampled keyframe, at most."""

    def __post_init__(self) -> None:
        """Reject invalid values."""
        if self.scale:
            parse_scale(self.scale)
        if self.marker_size_m < 0 or self.marker_size_m > 5:
            raise UsageError(
                f"marker size {self.marker_size_m:g} m: give the side of the black square in metres (at most 5)"
            )


WORLD_PRESETS = {
    "fast": WorldConfig(max_frames=24, samples_per_frame=3000),
    "default": WorldConfig(),
    "quality": WorldConfig(max_frames=96, samples_per_frame=6000),
}
