"""Convert COCO and labelme files to `OutlineLabels`; each class name names one object."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from reconstruction.measure.outline_labels import LabelledFrame, Outline, OutlineLabels, points, whole

IGNORE = "ignore"  # name of shapes that are ignored regions


def from_coco(path: Path, data: dict, names: Sequence[str] | None) -> OutlineLabels:
    """Convert COCO: a category is an object, an annotation its polygons; file order is back to front.

    Crowds (`iscrowd`) and annotations of the category `ignore` are ignored regions. `names`: see `load_outlines`.

    Raises:
        ValueError: an annotation has no polygons, a category occurs twice in one image, or a reference is invalid.
    """
    category = {c["id"]: str(c["name"]) for c in data.get("categories", [])}
    outlines: dict[Any, list[Outline]] = {image["id"]: [] for image in data["images"]}
    ignored: dict[Any, list[np.ndarray]] = {image["id"]: [] for image in data["images"]}
    for entry in data["annotations"]:
        picture, where = entry["image_id"], f"annotation {entry.get('id', '?')}"
        if picture not in outlines:
            raise ValueError(f"{where}: image {picture} is not in `images`")
        if entry["category_id"] not in category:
            raise ValueError(f"{where}: category {entry['category_id']} is not in `categories`")
        name = category[entry["category_id"]]
        polygons = _coco_polygons(entry.get("segmentation"), where)
        if name.lower() == IGNORE or entry.get("iscrowd"):
            ignored[picture] += polygons
            continue
        if any(outline.name == name for outline in outlines[picture]):
            raise ValueError(
                f"{where}: image {picture} has two annotations of {name!r}; give two objects two categories, and put "
                "all polygons of one object into one annotation"
            )
        outlines[picture] += [Outline(name, polygon) for polygon in polygons]
    frames = [
        LabelledFrame(
            frame_of(str(image["file_name"]), names),
            whole(image, "width"),
            whole(image, "height"),
            tuple(outlines[image["id"]]),
            tuple(ignored[image["id"]]),
        )
        for image in data["images"]
        if outlines[image["id"]] or ignored[image["id"]]  # images without annotations count as unlabelled
    ]
    return _labels(path, frames)


def _coco_polygons(segmentation: Any, where: str) -> list[np.ndarray]:
    if not isinstance(segmentation, list) or not segmentation:
        raise ValueError(
            f"{where}: `segmentation` is not a list of polygons; export polygons instead of masks (RLE)"
        )
    out = []
    for numbers in segmentation:
        flat = np.array(numbers, np.float64)
        if flat.ndim != 1 or flat.size % 2:
            raise ValueError(f"{where}: a COCO polygon is a flat list x1, y1, x2, y2, …")
        out.append(flat.reshape(-1, 2))
    return out


def from_labelme(path: Path, files: Mapping[Path, Any], names: Sequence[str] | None) -> OutlineLabels:
    """Convert labelme, one file per image: a label is an object; file order is back to front.

    Shapes with the same label in one file are parts of one object and share a `group_id`. `names`: see `load_outlines`.

    Raises:
        ValueError: a file has another format, a shape is no polygon or rectangle, or two objects have the same label.
    """
    frames = []
    for file, data in files.items():
        if not isinstance(data, dict) or not {"shapes", "imagePath"} <= set(data):
            raise ValueError(f"{file.name} is not a labelme file; give one labels file instead of the folder")
        outlines, ignored, groups = [], [], {}
        for shape in data["shapes"]:
            name, polygon = str(shape["label"]), _labelme_polygon(shape, file)
            if name.lower() == IGNORE:
                ignored.append(polygon)
                continue
            group = shape.get("group_id")
            if name in groups and (group is None or groups[name] != group):
                raise ValueError(
                    f"{file.name}: two shapes are {name!r}; give two objects two labels, and parts of one object the "
                    "same group id"
                )
            groups[name] = group
            outlines.append(Outline(name, polygon))
        index = frame_of(str(data["imagePath"]), names)
        width, height = whole(data, "imageWidth"), whole(data, "imageHeight")
        frames.append(LabelledFrame(index, width, height, tuple(outlines), tuple(ignored)))
    return _labels(path, frames)


def _labelme_polygon(shape: dict, file: Path) -> np.ndarray:
    kind, corners = shape.get("shape_type", "polygon"), points(shape["points"])
    if kind == "polygon":
        return corners
    if kind == "rectangle" and corners.shape == (2, 2):
        (x0, y0), (x1, y1) = corners
        return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])
    raise ValueError(f"{file.name}: {shape['label']!r} is a {kind}; draw polygons or rectangles")


def frame_of(picture: str, names: Sequence[str] | None) -> int:
    """Return the frame index of an image file: its position in `names`, or for a video the number in its name.

    Raises:
        ValueError: `names` is None or lacks the image, or its name does not contain exactly one number.
    """
    stem = Path(picture.replace("\\", "/")).stem
    if names is None:
        raise ValueError(
            f"the frame index of {picture} is unknown, because the scene's folder of images is missing; "
            "give it with `simrecon evaluate --video FOLDER`"
        )
    if names:
        stems = [Path(name).stem.lower() for name in names]
        if stem.lower() not in stems:
            raise ValueError(f"{picture} is none of the {len(names)} images of the scene ({names[0]}, …)")
        return stems.index(stem.lower())
    digits = re.fullmatch(r"\D*(\d+)\D*", stem)
    if digits is None:
        raise ValueError(
            f"the frame index of {picture} is unknown; name images by the number of their video frame, for example "
            "frame_00120.jpg"
        )
    return int(digits[1])


def _labels(path: Path, frames: list[LabelledFrame]) -> OutlineLabels:
    things = {outline.name: None for frame in frames for outline in frame.outlines}
    return OutlineLabels(path, tuple(frames), things)
