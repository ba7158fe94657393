"""Where 2D masks come from: a folder that any other tool filled, or learned models."""

from reconstruction.instances.masks.base import (
    FrameMasks,
    ImageSegmenter,
    KeyframeMasks,
    MaskBackend,
    flatten_masks,
)

__all__ = ["FrameMasks", "ImageSegmenter", "KeyframeMasks", "MaskBackend", "flatten_masks"]
