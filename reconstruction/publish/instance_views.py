"""Select keyframes that cover all objects well, and an anchor pixel per object; write both into the bundle.

`simrecon show SCENE --instances` draws its contact sheets from these files alone.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from reconstruction.core.types import FrameSet, InstanceSet, PosedFrames
from reconstruction.poses.lens import Lens

_COVERED_SHARE = 0.6  # of the best view's score, from which a view covers an object
_TRUNCATED_WEIGHT = 0.35  # of a view in which the image border truncates the object
_MIN_PX = 12  # pixels of an object, below which it is not visible
_SIDE_PX, _QUALITY = 960, 82  # longer side and JPEG quality of the stored frames


@dataclass(frozen=True)
class InstanceViews:
    """The selected frames and an anchor per object."""

    rows: tuple[int, ...]  # rows of the keyframes, in time order
    # id -> (row, x, y): x and y in the distorted video frame, divided by its width and height
    anchors: dict[int, tuple[int, float, float]]


def choose_views(id_maps: np.ndarray, ids: list[int], lenses: Sequence[Lens]) -> InstanceViews:
    """Select few keyframes that cover every visible object, by greedy set cover.

    Args:
        id_maps: uint16 (n, h, w) instance ids per undistorted keyframe.
        ids: objects to cover.
        lenses: distortion between the video and the undistorted frames, of each keyframe.

    Returns:
        The views; objects that no keyframe shows have no anchor.
    """
    quality = _quality(id_maps, ids)
    best = quality.max(axis=0, initial=0)
    visible = best > 0
    covers = (quality >= _COVERED_SHARE * best) & (quality > 0)
    share = quality / np.maximum(best, 1e-9)
    missing, chosen = visible.copy(), []
    while missing.any():
        gain = (
            (covers & missing).sum(axis=1) + 0.3 * (share * missing).mean(axis=1) + 0.1 * share.mean(axis=1)
        )
        chosen.append(int(np.argmax(gain)))
        missing &= ~covers[chosen[-1]]
    anchors = {}
    for k, number in enumerate(ids):
        if visible[k]:
            row = max(chosen, key=lambda r: (quality[r, k], -r))
            anchors[number] = (row, *_innermost_pixel(lenses[row].as_filmed(id_maps[row]) == number))
    return InstanceViews(tuple(sorted(chosen)), anchors)


def _quality(id_maps: np.ndarray, ids: list[int]) -> np.ndarray:
    """Score each keyframe for each object (n, k): its pixel count, down-weighted where the border truncates it."""
    out = np.zeros((len(id_maps), len(ids)))
    top = max(ids, default=0) + 1
    for row, picture in enumerate(id_maps):
        picture = np.asarray(picture)
        pixels = np.bincount(picture.ravel(), minlength=top)[ids]
        border = np.concatenate([picture[0], picture[-1], picture[:, 0], picture[:, -1]])
        at_border = np.bincount(border, minlength=top)[ids]
        out[row] = np.where(pixels >= _MIN_PX, pixels * np.where(at_border > 2, _TRUNCATED_WEIGHT, 1.0), 0.0)
    return out


def _innermost_pixel(mask: np.ndarray) -> tuple[float, float]:
    """Return x / width and y / height of the maximum of the mask's distance transform."""
    inner = cv2.distanceTransform(np.pad(mask.astype(np.uint8), 1), cv2.DIST_L2, 5)[1:-1, 1:-1]
    row, column = np.unravel_index(int(np.argmax(inner)), inner.shape)
    return (float(column) + 0.5) / mask.shape[1], (float(row) + 0.5) / mask.shape[0]


def write_views(
    found: InstanceSet, ids: list[int], frames: FrameSet, posed: PosedFrames, lens: Lens, folder: Path
) -> tuple[dict, dict[int, dict]]:
    """Write the selected video frames with an id map each: `instances/NNNNN.jpg` and `.png` (16-bit ids).

    Args:
        found: instances, with id maps of the undistorted keyframes.
        ids: objects of the scene.
        frames: keyframes as decoded, with lens distortion.
        posed: undistorted keyframes, in the order of the id maps.
        lens: distortion between the two.
        folder: of the bundle.

    Returns:
        The `instances` section of scene.json, and the `anchor` of each visible object: video frame and pixel, in
        pixels of the video.
    """
    lenses = [lens.at(int(index)) for index in posed.indices]
    views = choose_views(found.id_maps, ids, lenses)
    row_of = {int(index): row for row, index in enumerate(frames.indices)}
    (folder / "instances").mkdir(exist_ok=True)
    entries = []
    for row in views.rows:
        index = int(posed.indices[row])
        name = f"instances/{index:05d}"
        picture = _downscaled(np.asarray(frames.images[row_of[index]]))
        flags = [cv2.IMWRITE_JPEG_QUALITY, _QUALITY, cv2.IMWRITE_JPEG_OPTIMIZE, 1]
        cv2.imwrite(str(folder / f"{name}.jpg"), cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), flags)
        shown = lenses[row].as_filmed(found.id_maps[row])
        kept = np.where(np.isin(shown, ids), shown, 0).astype(np.uint16)
        cv2.imwrite(str(folder / f"{name}.png"), kept, [cv2.IMWRITE_PNG_COMPRESSION, 9])
        entries.append({"index": index, "image": f"{name}.jpg", "ids": f"{name}.png"})
    width, height = posed.source.width, posed.source.height
    anchors = {
        number: {"frame": int(posed.indices[row]), "x": round(x * width, 1), "y": round(y * height, 1)}
        for number, (row, x, y) in views.anchors.items()
    }
    return {"frames": entries}, anchors


def _downscaled(image: np.ndarray) -> np.ndarray:
    scale = min(1.0, _SIDE_PX / max(image.shape[:2]))
    if scale == 1.0:
        return np.ascontiguousarray(image)
    size = (max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale)))
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)
