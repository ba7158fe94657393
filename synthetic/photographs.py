"""Photographs as material for generated rooms: read from a folder on this machine, never part of the repository."""

from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np

_ENDINGS = (".jpg", ".jpeg", ".png")
_LARGEST_PX = 1024
_SMALLEST_PX = 128


def load_photographs(folder: Path, limit: int, rng: np.random.Generator) -> list[np.ndarray]:
    """Read photographs below a folder, for training only.

    Args:
        folder: Searched with all folders in it.
        limit: How many to return at most; which ones is drawn.
        rng: Draws them.

    Returns:
        uint8 (h, w, 3) sRGB each, read-only, at most 1024 px long. Files that are no pictures, or smaller than
        128 px, are passed over.
    """
    files = sorted(p for p in Path(folder).rglob("*") if p.suffix.lower() in _ENDINGS and p.is_file())
    out = []
    for number in rng.permutation(len(files)):
        if len(out) >= limit:
            break
        image = _decoded(str(files[int(number)]))
        if image is not None:
            out.append(image)
    return out


@lru_cache(maxsize=512)
def _decoded(path: str) -> np.ndarray | None:
    image = cv2.imread(path, cv2.IMREAD_COLOR)
    if image is None or min(image.shape[:2]) < _SMALLEST_PX:
        return None
    scale = _LARGEST_PX / max(image.shape[:2])
    if scale < 1:
        size = (max(round(image.shape[1] * scale), 1), max(round(image.shape[0] * scale), 1))
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    image = np.ascontiguousarray(image[..., ::-1])
    image.flags.writeable = False
    return image
