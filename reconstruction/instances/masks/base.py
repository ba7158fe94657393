"""Interface of mask backends.

The masks of one frame are one id image. Ids of two frames are unrelated; `reconstruction.instances.lifting` associates
the masks across views.
"""

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from reconstruction.core.progress import Progress
from reconstruction.core.types import Camera, DepthMaps, PosedFrames


@dataclass(frozen=True)
class FrameMasks:
    """Id images of posed frames, keyframes or others."""

    camera: Camera  # at the masks' resolution, without distortion
    frame_indices: np.ndarray  # int32 (n,) video frame numbers
    world_from_camera: np.ndarray  # float64 (n, 4, 4)
    ids: np.ndarray  # uint16 (n, h, w), 0 = in no mask

    def resized(self, width: int, height: int) -> "FrameMasks":
        """Return the masks at another resolution of the same aspect ratio, by the nearest pixel."""
        columns, rows = _centers(self.camera.width, width), _centers(self.camera.height, height)
        ids = np.ascontiguousarray(self.ids[:, rows[:, None], columns[None, :]])
        return replace(self, camera=self.camera.resized(width, height), ids=ids)


def _centers(full: int, wanted: int) -> np.ndarray:
    """Return the indices of `full` pixels at the centers of `wanted` pixels."""
    return np.minimum(((np.arange(wanted) + 0.5) * full / wanted).astype(np.int64), full - 1)


class MaskBackend(Protocol):
    """A source of masks for some frames of a capture."""

    name: str

    def frame_masks(self, posed: PosedFrames, depth: DepthMaps, *, progress: Progress) -> FrameMasks:
        """Return masks of frames with known cameras; `posed` and `depth` are in world space, in metres."""
        ...


class ImageSegmenter(Protocol):
    """A model that segments single images."""

    name: str

    def segment(self, image: np.ndarray) -> np.ndarray:
        """Return the id image uint16 (h, w) of an RGB image uint8 (h, w, 3), 0 = no mask."""
        ...


class KeyframeMasks:
    """A `MaskBackend` that segments every keyframe."""

    def __init__(self, segmenter: ImageSegmenter) -> None:
        self._segmenter = segmenter
        self.name = segmenter.name

    def frame_masks(self, posed: PosedFrames, depth: DepthMaps, *, progress: Progress) -> FrameMasks:
        """See `MaskBackend.frame_masks`; the masks have the resolution of the keyframes."""
        progress.start(len(posed.images), f"masks by {self.name}")
        ids = np.zeros(posed.images.shape[:3], np.uint16)
        for row, image in enumerate(posed.images):
            ids[row] = self._segmenter.segment(np.asarray(image))
            progress.advance()
        return FrameMasks(posed.camera, posed.indices, posed.world_from_camera, ids)


def flatten_masks(masks: np.ndarray, scores: np.ndarray) -> np.ndarray:
    """Merge overlapping masks bool (k, h, w), k >= 0, with scores (k,) into one id image uint16 (h, w).

    Of two masks with an IoU above 0.8 the one with the higher score is kept. A pixel gets the smallest mask that
    contains it, since the mask of an object often lies within that of its support.
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
