"""The frames that show the things of a scene best, and a point on each to click on: what a bundle keeps of them.

`simrecon show SCENE --instances` draws its contact sheets from these files alone.
"""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from reconstruction.core.types import FrameSet, InstanceSet, PosedFrames
from reconstruction.poses.lens import Lens

_SEEN_WELL = 0.6  # of the best view's pixels
_CUT_OFF = 0.35  # what a view counts in which the picture's border cuts the thing
_FEWEST_PX = 12
_SIDE_PX, _QUALITY = 960, 82  # of the frames that a bundle keeps


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


def write_views(
    found: InstanceSet, ids: list[int], frames: FrameSet, posed: PosedFrames, lens: Lens, folder: Path
) -> tuple[dict, dict[int, dict]]:
    """Write the chosen frames as they were filmed, and beside each which thing its pixels show.

    Args:
        found: the cut.
        ids: the things that are in the scene.
        frames: the film's keyframes as they were filmed.
        posed: the straightened ones, whose rows the id maps have.
        lens: from the film to straightened frames.
        folder: of the bundle; `instances/NNNNN.jpg` and `.png` (16-bit ids) are written.

    Returns:
        The `instances` section of scene.json, and for each thing that shows in a keyframe its `anchor`: the video
        frame and the pixel in it, in the video's own size.
    """
    views = choose_views(found.id_maps, ids, lens)
    row_of = {int(index): row for row, index in enumerate(frames.indices)}
    (folder / "instances").mkdir(exist_ok=True)
    entries = []
    for row in views.rows:
        index = int(posed.indices[row])
        name = f"instances/{index:05d}"
        picture = _fitted(np.asarray(frames.images[row_of[index]]))
        flags = [cv2.IMWRITE_JPEG_QUALITY, _QUALITY, cv2.IMWRITE_JPEG_OPTIMIZE, 1]
        cv2.imwrite(str(folder / f"{name}.jpg"), cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), flags)
        shown = lens.as_filmed(found.id_maps[row])
        kept = np.where(np.isin(shown, ids), shown, 0).astype(np.uint16)
        cv2.imwrite(str(folder / f"{name}.png"), kept, [cv2.IMWRITE_PNG_COMPRESSION, 9])
        entries.append({"index": index, "image": f"{name}.jpg", "ids": f"{name}.png"})
    width, height = posed.source.width, posed.source.height
    anchors = {
        number: {"frame": int(posed.indices[row]), "x": round(x * width, 1), "y": round(y * height, 1)}
        for number, (row, x, y) in views.anchors.items()
    }
    return {"frames": entries}, anchors


def _fitted(image: np.ndarray) -> np.ndarray:
    scale = min(1.0, _SIDE_PX / max(image.shape[:2]))
    if scale == 1.0:
        return np.ascontiguousarray(image)
    size = (max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale)))
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)
