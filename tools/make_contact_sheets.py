"""Draw pictures of what is found in films, as docs/instances.md shows them.

Usage: python tools/make_contact_sheets.py [--work DIR] [--overrides FILE] VIDEO=PICTURE.jpg ...

Each film (a video, or a folder of images) is reconstructed up to its instances; what is cached lies under DIR. Each
picture has the two frames that show the most things, and every thing for itself; at most 250 kB.
"""

import argparse
import dataclasses
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))  # runs from a checkout that is not installed

from reconstruction.cache import StageStore
from reconstruction.config import PipelineConfig
from reconstruction.core.types import InstanceSet
from reconstruction.editing.overrides import Overrides
from reconstruction.measure.report.contact_page import save_picture
from reconstruction.measure.report.contact_sheet import ContactSheet, crops_sheet, frame_picture
from reconstruction.publish.instance_views import write_views
from reconstruction.runner import Run

WIDTH_PX, GAP_PX, MAX_BYTES = 1320, 8, 250_000


def sheet_of(name: str, video: Path, work: Path, overrides: Overrides) -> ContactSheet:
    """Reconstruct a film up to its instances and return its contact sheet."""
    run = Run(video, PipelineConfig(), StageStore(work), overrides)
    run.execute(until="instances")
    found: InstanceSet = run.results["instances"]
    posed, _ = run.in_world()
    with tempfile.TemporaryDirectory() as folder:
        ids = [item.id for item in found.objects]
        views, anchors = write_views(found, ids, run.results["frames"], posed, run.lens(), Path(folder))
        objects = [
            {
                "id": item.id,
                "label": item.label,
                "label_confidence": item.label_confidence,
                "scale": item.extents_m.tolist(),
                **({"anchor": anchors[item.id]} if item.id in anchors else {}),
            }
            for item in found.objects
        ]
        edges = [
            {
                "child": item.id,
                "relation": "attached_to" if item.attached_hint else "supported_by",
                "parent": item.support_hint,
            }
            for item in found.objects
            if item.support_hint
        ]
        scene = {
            "id": name,
            "source": dataclasses.asdict(posed.source),
            "base": [{"id": item.id, "label": item.label} for item in found.base],
            "objects": objects,
            "graph": {"edges": edges},
            "instances": views,
        }
        return ContactSheet.read(scene, Path(folder).joinpath)


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
    parser.add_argument("pictures", nargs="+", metavar="VIDEO=PICTURE.jpg")
    parser.add_argument("--work", type=Path, default=Path("contact_sheets_work"))
    parser.add_argument("--overrides", type=Path, help="corrections of all these films")
    options = parser.parse_args()
    overrides = Overrides.load(options.overrides) if options.overrides else Overrides()
    for pair in options.pictures:
        video, _, path = pair.partition("=")
        name = Path(video).parent.name if Path(video).stem == "video" else Path(video).stem
        picture = overview(sheet_of(name, Path(video), options.work / name, overrides))
        for quality in range(84, 30, -4):
            save_picture(picture, Path(path), quality)
            if Path(path).stat().st_size <= MAX_BYTES:
                break


if __name__ == "__main__":
    main()
