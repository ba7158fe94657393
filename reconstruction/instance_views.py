"""Choose the frames in which the things of a scene are best seen, and a point on each to click on."""

from dataclasses import dataclass

import cv2
import numpy as np

from reconstruction.instances.lens import Lens

_SEEN_WELL = 0.6  # of the best view's pixels
_CUT_OFF = 0.35  # what a view counts in which the picture's border cuts the thing
_FEWEST_PX = 12


@dataclass(frozen=True)
class InstanceViews:
    """The chosen frames, and where in them each thing is best pointed at."""

    rows: tuple[int, ...]  # of the keyframes, in time order
    anchors: dict[
        int, tuple[int, float, float]
    ]  # id -> row, x, y as shares of width and height, in the film as it is


def choose_views(id_maps: np.ndarray, ids: list[int], lens: Lens) -> InstanceViews:
    """Choose few keyframes so that each thing is seen well in at least one.

    Args:
        id_maps: uint16 (n, h, w) ids per straightened keyframe.
        ids: the things that count.
        lens: from the film to straightened frames.

    Returns:
        The views. A thing that shows in no keyframe has no anchor.
    """
    quality = _quality(id_maps, ids)
    best = quality.max(axis=0, initial=0)
    visible = best > 0
    well = (quality >= _SEEN_WELL * best) & (quality > 0)
    share = quality / np.maximum(best, 1e-9)
    missing, chosen = visible.copy(), []
    while missing.any():
        gain = (well & missing).sum(axis=1) + 0.3 * (share * missing).mean(axis=1) + 0.1 * share.mean(axis=1)
        chosen.append(int(np.argmax(gain)))
        missing &= ~well[chosen[-1]]
    anchors = {}
    for k, number in enumerate(ids):
        if visible[k]:
            row = max(chosen, key=lambda r: (quality[r, k], -r))
            anchors[number] = (row, *_inmost(lens.as_filmed(id_maps[row]) == number))
    return InstanceViews(tuple(sorted(chosen)), anchors)


def _quality(id_maps: np.ndarray, ids: list[int]) -> np.ndarray:
    """Return (n, k) how well each keyframe shows each thing: its pixels, fewer if the border cuts it."""
    out = np.zeros((len(id_maps), len(ids)))
    top = max(ids, default=0) + 1
    for row, picture in enumerate(id_maps):
        picture = np.asarray(picture)
        pixels = np.bincount(picture.ravel(), minlength=top)[ids]
        rim = np.concatenate([picture[0], picture[-1], picture[:, 0], picture[:, -1]])
        at_rim = np.bincount(rim, minlength=top)[ids]
        out[row] = np.where(pixels >= _FEWEST_PX, pixels * np.where(at_rim > 2, _CUT_OFF, 1.0), 0.0)
    return out


def _inmost(mask: np.ndarray) -> tuple[float, float]:
    """Return the pixel of a mask that is farthest from its border, as shares of width and height."""
    inner = cv2.distanceTransform(np.pad(mask.astype(np.uint8), 1), cv2.DIST_L2, 5)[1:-1, 1:-1]
    row, column = np.unravel_index(int(np.argmax(inner)), inner.shape)
    return (float(column) + 0.5) / mask.shape[1], (float(row) + 0.5) / mask.shape[0]
