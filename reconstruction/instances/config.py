"""Settings of the instances stage."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class InstancesConfig:
    """How the surface is segmented into objects, and who names them."""

    masks: Literal["embedded", "folder", "sam2", "sam3", "mask2former"] | str = "embedded"
    """Segmentation method: `embedded` (learned partition of the surface, nothing to install), `folder` (2D masks of any
    other tool), `sam2`, `sam3` or `mask2former` (2D masks by models, through transformers)."""

    masks_path: str = ""
    """For `folder`: the folder with one id image per frame (PNG, 8 or 16 bit, 0 = no mask), named by video frame number
    (`00040.png`) or like the image that it belongs to."""

    masks_model: str = ""
    """For mask models: name on the Hugging Face hub, or a folder; empty: the default model."""

    masks_concepts: str = ""
    """For `sam3`: comma-separated noun phrases to segment ("chair, cup"); empty: everything, by a grid of points."""

    masks_points: int = 32
    """For `sam2`, and `sam3` without concepts: points per side of the grid; the time grows with the square."""

    labels: Literal["embedded", "clip", "vlm"] | str = "embedded"
    """Source of labels: `embedded` (coarse classes from shape and place), `clip` (any words, through transformers) or
    `vlm` (an OpenAI-compatible endpoint, see `SIMRECON_VLM_URL`)."""

    labels_model: str = ""
    """For `clip`: name on the Hugging Face hub, or a folder; empty: CLIP ViT-B/32. For `vlm`: name at the endpoint;
    empty: `SIMRECON_VLM_MODEL`."""

    labels_vocabulary: str = ""
    """For `clip`: comma-separated words to choose from; empty: a built-in list of household objects."""

    learned_device: str = "auto"
    """Device of learned models: `cpu`, `cuda`, ...; `auto`: CUDA where available."""

    min_object_vertices: int = 25
    """Least number of surface vertices of an object."""

    min_object_area_m2: float = 0.003
    """Least observed surface area of an object."""

    min_object_image_share: float = 4e-4
    """Least share of the pixels that an object must cover in at least one keyframe."""

    structure: bool = True
    """Keep the measured surface of no object and no base plane as one static body that carries objects."""

    min_structure_area_m2: float = 0.02
    """Least area of a connected component of that surface: a small book's."""

    min_picture_m: float = 0.10
    """Least length of the shorter side of a picture on a wall that is found by its masks alone."""

    snap_radius_px: int = 3
    """How far borders of id maps may move to image edges, in pixels at depth resolution; 0: not at all."""


INSTANCES_PRESETS = {
    "fast": InstancesConfig(snap_radius_px=0),
    "default": InstancesConfig(),
    "quality": InstancesConfig(),
}
