"""The seam for 2D masks: whatever cuts images into segments feeds the same lifting.

Masks of one frame are one id image; the ids of two frames have nothing to do with each other. What they mean in the
room is decided by `reconstruction.instances.lifting`, from their agreement across views.
"""

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from reconstruction.core.progress import Progress
from reconstruction.core.types import Camera, DepthMaps, PosedFrames


@dataclass(frozen=True)
class FrameMasks:
    """Segments of posed frames, keyframes or others."""

    camera: Camera  # at the masks' resolution, without distortion
    frame_indices: np.ndarray  # int32 (n,) video frame numbers
    world_from_camera: np.ndarray  # float64 (n, 4, 4)
    ids: np.ndarray  # uint16 (n, h, w), 0 = in no mask

    def resized(self, width: int, height: int) -> "FrameMasks":
        """Return the masks at another resolution of the same aspect; a pixel takes what lies at its center."""
        columns, rows = _centers(self.camera.width, width), _centers(self.camera.height, height)
        ids = np.ascontiguousarray(self.ids[:, rows[:, None], columns[None, :]])
        return replace(self, camera=self.camera.resized(width, height), ids=ids)


def _centers(full: int, wanted: int) -> np.ndarray:
    """Return which of `full` pixels lie at the centers of `wanted` ones."""
    return np.minimum(((np.arange(wanted) + 0.5) * full / wanted).astype(np.int64), full - 1)


class MaskBackend(Protocol):
    """Makes masks of some frames of a capture, or finds them."""

    name: str

    def frame_masks(self, posed: PosedFrames, depth: DepthMaps, *, progress: Progress) -> FrameMasks:
        """Return masks of frames with known cameras; `posed` and `depth` are in world space, in metres."""


class ImageSegmenter(Protocol):
    """Cuts single images into segments."""

    name: str

    def segment(self, image: np.ndarray) -> np.ndarray:
        """Return uint16 (h, w) ids of an RGB image uint8 (h, w, 3), 0 = in no segment."""


class KeyframeMasks:
    """Every keyframe through an image segmenter: a `MaskBackend`."""

    def __init__(self, segmenter: ImageSegmenter) -> None:
        """Wrap a segmenter."""
        self._segmenter = segmenter
        self.name = segmenter.name

    def frame_masks(self, posed: PosedFrames, depth: DepthMaps, *, progress: Progress) -> FrameMasks:
        """See `MaskBackend.frame_masks`; the masks are as large as the frames."""
        progress.start(len(posed.images), f"masks by {self.name}")
        ids = np.zeros(posed.images.shape[:3], np.uint16)
        for row, image in enumerate(posed.images):
            ids[row] = self._segmenter.segment(np.asarray(image))
            progress.advance()
        return FrameMasks(posed.camera, posed.indices, posed.world_from_camera, ids)


def flatten_masks(masks: np.ndarray, scores: np.ndarray) -> np.ndarray:
    """Return one id image, uint16 (h, w), of overlapping masks bool (k, h, w), k >= 0, with scores (k,).

    A pixel goes to the smallest mask that holds it, for a thing's mask lies within that of what it stands on; of two
    masks of nearly one extent (IoU above 0.8) the one with the higher score stays.
    """
    masks, scores = np.asarray(masks, bool), np.asarray(scores, np.float64)
    area = masks.sum(axis=(1, 2))
    kept: list[int] = []
    for k in np.lexsort((np.arange(len(masks)), -scores)):
        doubled = area[k] == 0
        for other in kept:
            if doubled or min(area[k], area[other]) <= 0.8 * max(area[k], area[other]):
                continue
            common = np.count_nonzero(masks[k] & masks[other])
            doubled = common > 0.8 * (area[k] + area[other] - common)
        if not doubled:
            kept.append(int(k))
    out = np.zeros(masks.shape[1:], np.uint16)
    for number, k in enumerate(sorted(kept, key=lambda k: (-area[k], k)), start=1):
        out[masks[k]] = number
    return out
