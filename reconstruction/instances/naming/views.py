"""Image crops of an object for naming: its best keyframes, with the background dimmed."""

from dataclasses import dataclass

import cv2
import numpy as np

from reconstruction.core.types import InstanceSet, PosedFrames

_MIN_PIXELS = 30  # of the object at id-map resolution, for a keyframe to be used
_MARGIN = 0.25  # around the crop on each side, of the object's size
_CUT_PENALTY = 0.4  # factor on the score where the image border cuts the object
_ALIKE_PENALTY = 0.7  # loss of score from the same direction as a chosen view
_DIMMED = 0.4  # brightness of the background
_OUTLINE = (255, 40, 160)  # RGB


@dataclass(frozen=True)
class ObjectView:
    """One object in one keyframe, cropped."""

    row: int  # of the keyframe
    crop: np.ndarray  # uint8 (h, w, 3) RGB
    mask: np.ndarray  # bool (h, w), where the object is in the crop

    def dimmed(self) -> np.ndarray:
        """Return the crop, uint8 (h, w, 3), with a darker background."""
        dark = (self.crop * _DIMMED).astype(np.uint8)
        return np.where(self.mask[..., None], self.crop, dark)

    def outlined(self) -> np.ndarray:
        """Return the dimmed crop with a line around the object."""
        edges, _ = cv2.findContours(self.mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        width = max(1, round(max(self.crop.shape[:2]) / 200))
        return cv2.drawContours(np.ascontiguousarray(self.dimmed()), edges, -1, _OUTLINE, width, cv2.LINE_AA)


def best_views(found: InstanceSet, posed: PosedFrames, count: int = 3) -> dict[int, list[ObjectView]]:
    """Return up to `count` views of each object, by id, the best first; an empty list where no keyframe shows it."""
    ids = np.asarray(found.id_maps)
    size = max((item.id for item in found.objects), default=0) + 1
    area = np.stack([np.bincount(one.ravel(), minlength=size)[:size] for one in ids])
    border = [np.concatenate([one[0], one[-1], one[:, 0], one[:, -1]]) for one in ids]
    cut = np.stack([np.bincount(one, minlength=size)[:size] for one in border])
    views = {}
    for item in found.objects:
        seen = area[:, item.id].astype(np.float64)
        score = np.where(seen >= _MIN_PIXELS, seen, 0.0) * np.where(cut[:, item.id] > 3, _CUT_PENALTY, 1.0)
        rows = _spread_out(score, _directions(posed, item.center), count)
        views[item.id] = [_crop(np.asarray(posed.images[row]), ids[row] == item.id, row) for row in rows]
    return views


def collage(pictures: list[np.ndarray], height_px: int = 448) -> np.ndarray:
    """Return images uint8 (h, w, 3) of any size side by side, as one image of the given height."""
    sized = []
    for picture in pictures:
        scale = min(height_px / picture.shape[0], height_px / picture.shape[1])
        width, height = max(1, round(picture.shape[1] * scale)), max(1, round(picture.shape[0] * scale))
        how = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
        cell = np.full((height_px, width + 8, 3), 255, np.uint8)
        top = (height_px - height) // 2
        cell[top : top + height, 4 : 4 + width] = cv2.resize(picture, (width, height), interpolation=how)
        sized.append(cell)
    return np.concatenate(sized, axis=1)


def _directions(posed: PosedFrames, center: np.ndarray) -> np.ndarray:
    """Return unit vectors (n, 3) from each camera to a point."""
    rays = center - posed.world_from_camera[:, :3, 3]
    return rays / np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-9)


def _spread_out(score: np.ndarray, directions: np.ndarray, count: int) -> list[int]:
    """Select rows greedily by score; after each, views from similar directions lose score."""
    score, rows = score.copy(), []
    while len(rows) < count and score.max() > 0:
        row = int(np.argmax(score))
        rows.append(row)
        alike = np.clip(directions @ directions[row], 0.0, 1.0) ** 8
        score *= 1.0 - _ALIKE_PENALTY * alike
        score[row] = 0.0
    return rows


def _crop(image: np.ndarray, mask: np.ndarray, row: int) -> ObjectView:
    """Crop an object from its keyframe; the mask (h, w) may have another resolution than the image."""
    height, width = image.shape[:2]
    large = cv2.resize(mask.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR) > 0.5
    if not large.any():  # isolated pixels vanish by interpolation
        large = cv2.resize(mask.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST) > 0
    ys, xs = np.nonzero(large.any(axis=1))[0], np.nonzero(large.any(axis=0))[0]
    pad_y, pad_x = (round(_MARGIN * (axis[-1] - axis[0] + 1)) + 4 for axis in (ys, xs))
    window = (
        slice(max(0, ys[0] - pad_y), min(height, ys[-1] + 1 + pad_y)),
        slice(max(0, xs[0] - pad_x), min(width, xs[-1] + 1 + pad_x)),
    )
    return ObjectView(row, np.ascontiguousarray(image[window]), large[window])
