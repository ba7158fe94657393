"""Draw pictures of what was found in registered scenes, as docs/instances.md shows them.

Usage: python tools/make_contact_sheets.py [--registry DIR] SCENE=PICTURE.jpg ...

Each picture has the two frames that show the most things, and every thing for itself; at most 250 kB.
"""

import argparse
import sys
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))  # runs from a checkout that is not installed

from reconstruction.report.contact_page import save_picture
from reconstruction.report.contact_sheet import ContactSheet, crops_sheet, frame_picture
from registry import SceneRegistry

WIDTH_PX, GAP_PX, MAX_BYTES = 1320, 8, 250_000


def overview(sheet: ContactSheet) -> np.ndarray:
    """Return the two fullest frames above pictures of all things: uint8 (h, WIDTH_PX, 3)."""
    fullest = sorted(sheet.frames, key=lambda f: (-len(sheet.shown_in(f)), f.index))[:2]
    frames = [frame_picture(sheet, f) for f in sorted(fullest, key=lambda f: f.index)]
    height = min(frame.shape[0] for frame in frames)
    frames = [cv2.resize(f, (f.shape[1] * height // f.shape[0], height)) for f in frames]
    gap = np.full((height, GAP_PX, 3), 255, np.uint8)
    top = np.hstack([frames[0], *(part for frame in frames[1:] for part in (gap, frame))])
    things = crops_sheet(sheet, columns=7)
    return np.vstack([_to_width(top), np.full((GAP_PX, WIDTH_PX, 3), 255, np.uint8), _to_width(things)])


def _to_width(image: np.ndarray) -> np.ndarray:
    height = round(image.shape[0] * WIDTH_PX / image.shape[1])
    return cv2.resize(image, (WIDTH_PX, height), interpolation=cv2.INTER_AREA)


def main() -> None:
    """Write the pictures."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("pictures", nargs="+", metavar="SCENE=PICTURE.jpg")
    parser.add_argument("--registry", type=Path)
    options = parser.parse_args()
    registry = SceneRegistry(options.registry)
    for pair in options.pictures:
        scene, _, path = pair.partition("=")
        picture = overview(ContactSheet.of(registry.load(scene)))
        for quality in range(84, 30, -4):
            save_picture(picture, Path(path), quality)
            if Path(path).stat().st_size <= MAX_BYTES:
                break


if __name__ == "__main__":
    main()
