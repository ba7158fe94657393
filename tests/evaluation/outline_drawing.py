"""Outlines of the true id maps of a generated room, written in three file formats."""

import json
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from truth_bundle import KINDS, Truth

FRAMES = (0, 10, 20)


def pieces(mask: np.ndarray) -> list[np.ndarray]:
    """Return the outer contours (k, 2) of a mask through the centers of its border pixels."""
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return [contour[:, 0] + 0.5 for contour in contours if len(contour) > 2]


def true_ids(truth: Truth, index: int) -> np.ndarray:
    """Read the true entity ids uint16 (h, w) of a frame."""
    return cv2.imread(str(truth.folder / "instances" / f"{index:05d}.png"), cv2.IMREAD_UNCHANGED)


@dataclass
class Drawing:
    """Outlines by frame, back to front, as [(name, polygon), …], with parents and ignored regions."""

    size: tuple[int, int]
    frames: dict[int, list[tuple[str, np.ndarray]]]
    parents: dict[str, str]
    ignore: list[str] = field(default_factory=list)
    regions: dict[int, list[np.ndarray]] = field(default_factory=dict)

    def contract(self, path: Path) -> Path:
        """Write the format of CONTRACT section 5."""
        width, height = self.size
        frames = [
            {
                "index": index,
                "width": width,
                "height": height,
                "things": [{"name": name, "polygon": polygon.tolist()} for name, polygon in shapes],
                "ignore_regions": [polygon.tolist() for polygon in self.regions.get(index, [])],
            }
            for index, shapes in self.frames.items()
        ]
        things = {name: {"kind": "object", "parent": parent} for name, parent in self.parents.items()}
        path.write_text(
            json.dumps({"capture": "room", "frames": frames, "things": things, "ignore": self.ignore})
        )
        return path

    def coco(self, path: Path) -> Path:
        """Write COCO: one category per object, one annotation per object and image."""
        categories = {name: number for number, name in enumerate([*self.parents, "ignore"], start=1)}
        width, height = self.size
        images = [
            {"id": k, "file_name": f"pictures/f_{i:05d}.jpg", "width": width, "height": height}
            for k, i in enumerate(self.frames)
        ]
        annotations = []
        for k, (index, shapes) in enumerate(self.frames.items()):
            for name in dict.fromkeys(name for name, _ in shapes):
                polygons = [polygon.ravel().tolist() for own, polygon in shapes if own == name]
                annotations.append({"image_id": k, "category_id": categories[name], "segmentation": polygons})
            annotations += [
                {"image_id": k, "category_id": categories["ignore"], "segmentation": [p.ravel().tolist()]}
                for p in self.regions.get(index, [])
            ]
        for number, entry in enumerate(annotations):
            entry.update(id=number, iscrowd=0)
        named = [{"id": number, "name": name} for name, number in categories.items()]
        path.write_text(json.dumps({"images": images, "annotations": annotations, "categories": named}))
        return path

    def labelme(self, folder: Path) -> Path:
        """Write labelme: one file per image."""
        folder.mkdir()
        for index, shapes in self.frames.items():
            found = [
                {"label": name, "points": polygon.tolist(), "group_id": 1, "shape_type": "polygon"}
                for name, polygon in shapes
            ]
            found += [{"label": "ignore", "points": p.tolist()} for p in self.regions.get(index, [])]
            document = {"version": "5.5.0", "shapes": found, "imagePath": f"..\\f_{index:05d}.jpg"}
            document |= {"imageWidth": self.size[0], "imageHeight": self.size[1]}
            (folder / f"f_{index:05d}.json").write_text(json.dumps(document))
        return folder


def draw(truth: Truth, ids: dict[int, np.ndarray] | None = None) -> Drawing:
    """Outline all objects of the room in FRAMES, larger ones first; `ids` replaces the true id maps."""
    ids = ids or {index: true_ids(truth, index) for index in FRAMES}
    frames = {}
    for index, shown in ids.items():
        masks = {name: shown == truth.entity(name).id for name in KINDS}
        order = sorted(KINDS, key=lambda name: -masks[name].sum())
        frames[index] = [(name, polygon) for name in order for polygon in pieces(masks[name])]
    by_id = {e.id: e.label if e.base else e.name for e in truth.room.entities}
    parents = {name: by_id[truth.entity(name).parent] for name in KINDS}
    return Drawing((truth.camera.width, truth.camera.height), frames, parents)
