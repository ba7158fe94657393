"""Settings of the depth stage. Nothing here is metric: the scale of the poses is arbitrary."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class DepthConfig:
    """How depth is measured in every keyframe and completed where nothing can be measured."""

    depth_side_px: int = 480
    """Longer side of the depth maps (smaller where the frames are smaller)."""

    sweep_side_px: int = 320
    """Longer side at which all planes are tried; the winner is then refined at the full depth resolution."""

    planes: int = 96
    """Inverse-depth planes of the sweep."""

    sources: int = 4
    """Other frames that every frame is compared with."""

    neighbors: int = 10
    """Other frames whose depth maps must agree before a pixel counts as measured."""

    best_angle_deg: float = 7.0
    """Triangulation angle at which a source is most welcome."""

    noise_gray: float = 2.0
    """Standard deviation of image noise in gray levels; windows with less contrast give no evidence."""

    smooth_small: float = 0.06
    """Aggregation penalty of a change by one plane, in units of correlation."""

    smooth_large: float = 0.45
    """Aggregation penalty of a depth edge where the image shows no edge, in units of correlation."""

    refine_rounds: int = 2
    """Rounds of slanted-window refinement."""

    min_correlation: float = 0.35
    """Refined windows that correlate less than this with their sources are not measured."""

    agree_depth: float = 0.01
    """Relative depth difference up to which another view agrees."""

    agree_px: float = 1.0
    """Reprojection error up to which another view agrees, at depth resolution."""

    min_agreeing: int = 2
    """Other views that must agree before a pixel counts as measured."""

    min_speckle_px: int = 60
    """Smaller islands of measured depth are dropped."""

    prior: Literal["none", "mending", "both"] = "both"
    """The networks in use (docs/priors.md): "mending" puts every pixel on one of the surfaces around it or on none;
    with "both", depth is predicted from the costs before that, where nothing was measured."""

    prior_surety: float = 0.4
    """Probability from which the network's depth is asked for where windows measure nothing."""

    prior_agree_depth: float = 0.03
    """Relative depth difference up to which two views predict the same."""

    prior_agree_px: float = 4.0
    """Reprojection error up to which they do, at depth resolution."""

    mend_surety: float = 0.4
    """Probability from which depth is believed after mending."""

    complete: bool = True
    """Fill planes where there is no texture and the surroundings support it."""

    monocular: Literal["none", "transformers"] | str = "none"
    """Learned depth from single images for what nothing else reaches; needs `pip install 'simrecon[depth-models]'`."""

    monocular_model: str = "depth-anything/Depth-Anything-V2-Small-hf"
    """Its model, relative or metric, as on the Hugging Face hub, or a local folder."""

    edge_rounds: int = 2
    """Rounds in which pixels beside a depth jump choose anew the surface that they lie on."""

    threads: int = 0
    """Frames worked on at once; 0 = one per processor. Does not change the result."""

    seed: int = 0
    """Seed of the random sampling of planes."""

    perturb: int = 0
    """Seed of noise in the last bits of the finished maps, to measure what chance does to figures; 0 = none."""


DEPTH_PRESETS: dict[str, DepthConfig] = {
    "fast": DepthConfig(
        depth_side_px=384, sweep_side_px=256, planes=72, refine_rounds=1, neighbors=8, edge_rounds=1
    ),
    "default": DepthConfig(),
    "quality": DepthConfig(depth_side_px=640, sweep_side_px=426, planes=128, sources=6, refine_rounds=3),
}
