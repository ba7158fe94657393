"""Sources of 2D masks: a folder of id images made by any tool, or segmentation models."""

from reconstruction.instances.masks.base import (
    FrameMasks,
    ImageSegmenter,
    KeyframeMasks,
    MaskBackend,
    flatten_masks,
)
from reconstruction.instances.masks.load import DEFAULT_MODELS, load_mask_backend

__all__ = [
    "DEFAULT_MODELS",
    "FrameMasks",
    "ImageSegmenter",
    "KeyframeMasks",
    "MaskBackend",
    "flatten_masks",
    "load_mask_backend",
]
