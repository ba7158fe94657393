"""Settings of the instances stage."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class InstancesConfig:
    """How the surface is cut into things."""

    masks: Literal["embedded", "folder", "sam2", "sam3", "mask2former"] = "embedded"
    """Where the cut comes from: `embedded` (the learned partition, nothing to install), `folder` (id images that any
    other tool made), `sam2`, `sam3` or `mask2former` (through transformers)."""

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

    min_object_vertices: int = 25
    """Things with fewer surface vertices than this are fragments."""

    min_object_area_m2: float = 0.003
    """Things of which less surface than this was seen are scraps."""

    min_object_image_share: float = 4e-4
    """Things that cover less of every keyframe than this are scraps."""

    min_picture_m: float = 0.10
    """The shorter side of the smallest picture on a wall that only masks show."""

    snap_radius_px: int = 3
    """How far the borders of id maps may move to a color edge, at depth resolution."""


INSTANCES_PRESETS = {
    "fast": InstancesConfig(snap_radius_px=0),
    "default": InstancesConfig(),
    "quality": InstancesConfig(),
}
