"""Read chosen frames of a video or a folder of images again, upright, in gray, at working size."""

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from reconstruction.frames.decoding import ImageFolder, VideoReader


def gray_frames(source: Path, wanted: set[int], max_side_px: int) -> Iterator[tuple[int, np.ndarray]]:
    """Yield (number, gray uint8 (h, w)) of the wanted frames that can be read, in order.

    Args:
        source: what `load_frames` read; frames are numbered alike.
        wanted: numbers of frames.
        max_side_px: longer side of the images, pixels; smaller ones are not enlarged.
    """
    if source.is_dir():
        folder = ImageFolder(source)
        for number in sorted(wanted):
            image = folder.load_rgb(number, max_side_px)
            if image is not None:
                yield number, cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        return
    reader, last = VideoReader(source), max(wanted, default=-1)
    for number, _, _, frame in reader.frames():
        if number in wanted:
            yield number, reader.to_gray(frame, max_side_px)
        if number >= last:
            return
