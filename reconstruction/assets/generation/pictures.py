"""Choice and encoding of the pictures of an object that a generator gets."""

import hashlib
from collections.abc import Sequence

import cv2
import numpy as np

from reconstruction.assets.generation.base import ObjectPictures, Picture
from reconstruction.core.types import Instance, InstanceSet, PosedFrames
from reconstruction.views import SceneViews, View

_LABEL_BELIEVED = 0.5  # least confidence of a label that is sent
_LEAST_FRONTS = 0.6  # least share of front faces in a view: the inside of a shell misleads a generator
_SPECK_SHARE = 0.1  # least size of a mask's component, relative to the largest


def object_pictures(
    found: InstanceSet, posed: PosedFrames, wanted: list[Instance], count: int, views: SceneViews | None = None
) -> dict[int, ObjectPictures]:  # fmt: skip
    """Return up to `count` pictures by object id, of each wanted object that has any.

    They are its views without occluders; keyframes replace missing views.
    """
    chosen = {} if views is None else {item.id: view_pictures(views.of(item.id), count) for item in wanted}
    frames = {} if all(chosen.get(item.id) for item in wanted) else keyframe_pictures(found, posed, count)
    out = {}
    for item in wanted:
        pictures = chosen.get(item.id) or frames.get(item.id)
        if pictures:
            label = item.label if item.label_confidence >= _LABEL_BELIEVED and item.label != "unknown" else ""
            out[item.id] = ObjectPictures(item.id, label, tuple(pictures))
    return out


def view_pictures(views: Sequence[View], count: int) -> list[Picture]:
    """Return up to `count` pictures of an object from its views, without occluders and without views of back faces."""
    shown = [view.cleared() for view in views if view.fronts >= _LEAST_FRONTS]
    return [Picture(color, without_specks(mask)) for color, mask in filter(None, shown)][:count]


def keyframe_pictures(found: InstanceSet, posed: PosedFrames, count: int) -> dict[int, list[Picture]]:
    """Return crops of the `count` keyframes that show each object best, by object id."""
    from reconstruction.instances.naming.views import best_views

    return {
        number: [Picture(view.crop, without_specks(view.mask)) for view in views if view.mask.any()]
        for number, views in best_views(found, posed, count).items()
    }


def without_specks(mask: np.ndarray) -> np.ndarray:
    """Drop small components of a mask, such as depth bleeding from neighbors."""
    _, labels, facts, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    sizes = facts[1:, cv2.CC_STAT_AREA]
    kept = 1 + np.flatnonzero(sizes >= _SPECK_SHARE * sizes.max())
    return np.isin(labels, kept)


def encode_png(image: np.ndarray) -> bytes:
    """Encode an RGB or RGBA image uint8 (h, w, c) as PNG."""
    how = cv2.COLOR_RGBA2BGRA if image.shape[2] == 4 else cv2.COLOR_RGB2BGR
    return cv2.imencode(".png", cv2.cvtColor(image, how))[1].tobytes()


def pixel_digest(picture: Picture) -> str:
    """Return a digest of a picture's pixels; that of a file would depend on the PNG library."""
    digest = hashlib.sha256(str(picture.color.shape).encode())
    digest.update(np.ascontiguousarray(picture.color).tobytes())
    digest.update(np.packbits(picture.mask).tobytes())
    return digest.hexdigest()[:32]
