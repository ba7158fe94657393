"""Where 2D masks come from: a folder that any other tool filled, or learned models."""

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
