"""Settings of the pose stage."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class PosesConfig:
    """How camera poses and intrinsics are estimated from the keyframes."""

    import_path: str = ""
    """Poses to import: a COLMAP model folder, a nerfstudio `transforms.json`, a Record3D recording or Polycam's raw
    data. Empty: those of the input, if it is such an export; else poses are estimated."""

    backend: Literal["colmap", "vggt"] | str = "colmap"
    """Source of the initial cameras: `colmap` (incremental mapping) or `vggt` (the learned model, if installed),
    whose prediction is then refined by bundle adjustment."""

    refine_imported: Literal["auto", "always", "never"] = "auto"
    """Refine imported poses by bundle adjustment, keeping their scale and coordinate frame. `auto`: those of phone
    apps, which drift; not those of COLMAP and nerfstudio, which were adjusted already."""

    max_features: int = 2048
    """SIFT features kept per frame, the strongest first."""

    contrast_threshold: float = 0.01
    """SIFT contrast threshold; half of COLMAP's, since rooms have pale walls."""

    sequential_overlap: int = 8
    """Each frame of a video is matched to this many following ones."""

    max_pairs_per_frame: int = 20
    """Further partners of a frame, chosen by visual overlap: they close loops and order image folders."""

    min_inliers: int = 20
    """Inliers of the two-view geometry that a pair needs."""

    camera_model: Literal["auto", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"] = "auto"
    """COLMAP camera model that all frames share. `auto`: SIMPLE_RADIAL, and RADIAL in the last bundle adjustment if
    there are enough frames for its second term."""

    min_registered_share: float = 0.35
    """Least share of the keyframes that must be registered; else the input is rejected."""

    second_try_below_share: float = 0.9
    """Below this registered share of the connected frames, models from other starts and the global mapper's compete."""

    second_try_below_explained: float = 0.95
    """Below this share of verified matches that fit the model, they do, too."""

    max_point_error_px: float = 2.0
    """Largest mean reprojection error of a sparse point, pixels."""

    min_track_length: int = 3
    """Least number of frames that observe a sparse point."""

    min_held_out_inliers: int = 20
    """2D-3D inliers that a held-out frame needs to be localized."""

    seed: int = 0
    """Seed of all random sampling."""


POSES_PRESETS: dict[str, PosesConfig] = {
    "fast": PosesConfig(max_features=1024, sequential_overlap=6, max_pairs_per_frame=12),
    "default": PosesConfig(),
    "quality": PosesConfig(max_features=4096, sequential_overlap=12, max_pairs_per_frame=32),
}
