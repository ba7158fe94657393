"""Which pictures of an object a generator is shown, and what they are sent as."""

import hashlib
from collections.abc import Sequence

import cv2
import numpy as np

from reconstruction.assets.generation.base import ObjectPictures, Picture
from reconstruction.core.types import Instance, InstanceSet, PosedFrames
from reconstruction.views import SceneViews, View

_LABEL_BELIEVED = 0.5
_LEAST_FRONTS = 0.6  # of what a view shows; of the inside of a shell no generator is to be told
_SPECK_SHARE = 0.1  # of an object's largest part in the picture


def object_pictures(
    found: InstanceSet,
    posed: PosedFrames,
    wanted: list[Instance],
    count: int,
    views: SceneViews | None = None,
) -> dict[int, ObjectPictures]:
    """Return up to `count` pictures of each wanted object that anything shows, by its id.

    Args:
        found: the objects and which pixels show them.
        posed: the keyframes.
        wanted: objects.
        count: of pictures.
        views: what the stage `views` chose: its pictures, without what hides the object; keyframes stand in for an
            object without views, and for all where it is None.
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
    """Return pictures of an object from its views, without what hides it; none from where backs are seen most."""
    shown = [view.cleared() for view in views if view.fronts >= _LEAST_FRONTS]
    return [Picture(color, _without_specks(mask)) for color, mask in filter(None, shown)][:count]


def keyframe_pictures(found: InstanceSet, posed: PosedFrames, count: int) -> dict[int, list[Picture]]:
    """Return the keyframes that show each object best, cropped, by its id."""
    from reconstruction.instances.naming.views import best_views

    return {
        number: [Picture(view.crop, _without_specks(view.mask)) for view in views if view.mask.any()]
        for number, views in best_views(found, posed, count).items()
    }


def _without_specks(mask: np.ndarray) -> np.ndarray:
    """Return a mask without what is small and apart: smears of its neighbors."""
    _, labels, facts, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    sizes = facts[1:, cv2.CC_STAT_AREA]
    kept = 1 + np.flatnonzero(sizes >= _SPECK_SHARE * sizes.max())
    return np.isin(labels, kept)


def encode_png(image: np.ndarray) -> bytes:
    """Return an RGB or RGBA image uint8 (h, w, c) as a PNG."""
    how = cv2.COLOR_RGBA2BGRA if image.shape[2] == 4 else cv2.COLOR_RGB2BGR
    return cv2.imencode(".png", cv2.cvtColor(image, how))[1].tobytes()


def pixel_digest(picture: Picture) -> str:
    """Return a name for what a picture shows (of its pixels, not of a file, which differs with its library)."""
    digest = hashlib.sha256(str(picture.color.shape).encode())
    digest.update(np.ascontiguousarray(picture.color).tobytes())
    digest.update(np.packbits(picture.mask).tobytes())
    return digest.hexdigest()[:32]
