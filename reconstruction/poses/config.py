"""Settings of the pose stage."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class PosesConfig:
    """How cameras are recovered from the keyframes."""

    import_path: str = ""
    """Poses that you have: a COLMAP model folder, a nerfstudio `transforms.json`, a Record3D recording or
    Polycam's raw data. Empty: those of the input, if it is such an export; else they are estimated."""

    backend: Literal["colmap", "vggt"] = "colmap"
    """Where first cameras come from: `colmap` from matches; `vggt` from the learned model of that name, if it is
    installed. Its prediction is then adjusted to our own matches."""

    refine_imported: Literal["auto", "always", "never"] = "auto"
    """Adjust imported poses to the pictures, keeping their scale and place. `auto`: those of phone apps, which
    drift; not those of COLMAP and nerfstudio, which were adjusted already."""

    max_features: int = 2048
    """SIFT features kept in each frame, the strongest first."""

    contrast_threshold: float = 0.01
    """SIFT contrast below which a feature is noise; half of COLMAP's, since rooms have pale walls."""

    sequential_overlap: int = 8
    """In a video every frame is matched to this many that follow it."""

    max_pairs_per_frame: int = 20
    """Further partners of a frame, chosen by what the frames show: this closes loops and orders folders."""

    min_inliers: int = 20
    """Matches that must agree with one two-view geometry before a pair counts."""

    camera_model: Literal["auto", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"] = "auto"
    """Lens model that all frames share. `auto` is SIMPLE_RADIAL, at the end RADIAL where there are enough
    frames to support its second term."""

    min_registered_share: float = 0.35
    """Fewer registered keyframes than this share of those given: the input is rejected."""

    second_try_below_share: float = 0.9
    """Below this registered share the global mapper is tried too, and the better model is kept."""

    max_point_error_px: float = 2.0
    """Sparse points with a larger mean reprojection error are dropped from the result."""

    min_track_length: int = 3
    """Sparse points seen in fewer frames are dropped from the result."""

    min_held_out_inliers: int = 20
    """2D-3D matches that a held-out frame needs to be located."""

    seed: int = 0
    """Seed of every random sampling."""


POSES_PRESETS: dict[str, PosesConfig] = {
    "fast": PosesConfig(max_features=1024, sequential_overlap=6, max_pairs_per_frame=12),
    "default": PosesConfig(),
    "quality": PosesConfig(max_features=4096, sequential_overlap=12, max_pairs_per_frame=32),
}
