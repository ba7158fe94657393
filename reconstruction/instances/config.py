"""Settings of the instances stage."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class InstancesConfig:
    """How the surface is cut into things."""

    cut: Literal["rules", "partition"] = "rules"
    """Without masks, what cuts: `rules` of shape, contact and color, or `partition`, multicuts of superpoints
    and of their clusters by learned affinities (best with `depth.prior=mending`)."""

    masks: Literal["embedded", "folder", "sam2", "sam3", "mask2former"] = "embedded"
    """Where the cut comes from: `embedded` (geometry and color, nothing to install), `folder` (id images that any other
    tool made), `sam2`, `sam3` or `mask2former` (through transformers)."""

    masks_path: str = ""
    """For `folder`: the folder with one id image (PNG, 8 or 16 bit, 0 = in no mask) a frame, named by video frame
    number (`00040.png`) or like the image that it belongs to."""

    masks_model: str = ""
    """For the learned ones: the model's name on the Hugging Face hub, or its folder; empty is the backend's choice."""

    masks_concepts: str = ""
    """For `sam3`: comma-separated things to look for ("chair, cup"); empty is everything, from a grid of points."""

    masks_points: int = 32
    """For `sam2` and `sam3` without concepts: points along each side of the grid; the time grows with their square."""

    labels: Literal["embedded", "clip", "vlm"] = "embedded"
    """Who names things: `embedded` (coarse classes from shape and place), `clip` (any words, through transformers) or
    `vlm` (an OpenAI-compatible endpoint, see `SIMRECON_VLM_URL`)."""

    labels_model: str = ""
    """For `clip`: the model's name on the Hugging Face hub, or its folder; empty is CLIP ViT-B/32. For `vlm`: its name
    at the endpoint; empty is `SIMRECON_VLM_MODEL`."""

    labels_vocabulary: str = ""
    """For `clip`: comma-separated words to choose from; empty is a list of household things."""

    learned_device: str = "auto"
    """Where learned models run: `cpu`, `cuda`, ...; `auto` is cuda where there is one."""

    min_object_m: float = 0.03
    """Things whose second-largest extent is below this are not objects."""

    min_object_vertices: int = 25
    """Things with fewer surface vertices than this are fragments."""

    min_piece_area_m2: float = 0.0015
    """Pieces of surface smaller than this are crumbs of what is near them."""

    min_object_area_m2: float = 0.003
    """Things of which less surface than this was seen are scraps."""

    min_object_image_share: float = 4e-4
    """Things that cover less of every keyframe than this are scraps."""

    min_floating_m: float = 0.45
    """Things in mid-air, on nothing and on no wall, whose longest side is below this are scraps."""

    contact_height_m: float = 0.008
    """What rises above a support plane by more than this (or by the plane's own noise) stands on it."""

    bridge_gap_m: float = 0.02
    """Pieces of surface closer than this may belong to one thing."""

    min_support_area_m2: float = 0.004
    """Smaller up-facing patches carry nothing."""

    min_picture_m: float = 0.10
    """The shorter side of the smallest picture that is looked for on a wall."""

    wall_color_contrast: float = 9.0
    """CIELAB distance from the wall's own color at which a part of it may be a picture."""

    split_color_contrast: float = 13.0
    """CIELAB distance across the contact of two touching patches that tells two things apart where the crease along it
    has `split_angle_deg`; the product of both counts."""

    split_angle_deg: float = 30.0
    """Mean concave angle along the contact of two touching patches that tells two things apart where their colors have
    `split_color_contrast`."""

    snap_radius_px: int = 3
    """How far the borders of id maps may move to a color edge, at depth resolution."""


INSTANCES_PRESETS = {
    "fast": InstancesConfig(snap_radius_px=0),
    "default": InstancesConfig(),
    "quality": InstancesConfig(),
}
