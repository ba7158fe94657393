"""Read a file of outlines in the project's own format, COCO or labelme, recognized by its keys."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from reconstruction.measure.outline_formats import from_coco, from_labelme
from reconstruction.measure.outline_labels import LabelledFrame, Outline, OutlineLabels, points, whole
from registry.errors import UsageError

_KNOWN = (
    "simrecon labels (`frames`, `things`), COCO (`images`, `annotations`), labelme (`shapes`, `imagePath`)"
)
_SEE = "docs/evaluation.md describes the formats"


def load_outlines(path: Path, names: Sequence[str] | None = ()) -> OutlineLabels:
    """Read outlines: CONTRACT section 5, COCO polygons, or labelme (one file per image, or a folder of them).

    COCO and labelme name images. The frame index is the number in the name (`frame_00120.jpg`), or the position in name
    order for a scene made from a folder of images.

    Args:
        path: the file, or the folder of labelme files.
        names: image files of the scene in name order; empty for a video; None for a folder that is missing.

    Raises:
        UsageError: the file is missing, malformed or of no known format, or an image is not a frame of the scene.
    """
    path = Path(path)
    try:
        return _read(path, names)
    except json.JSONDecodeError as error:
        raise UsageError(f"labels {path}: not JSON ({error})") from error
    except UnicodeDecodeError as error:
        raise UsageError(f"labels {path}: not a text file ({error})") from error
    except KeyError as error:
        raise UsageError(f"labels {path}: malformed, {error} is missing; {_SEE}") from error
    except (TypeError, AttributeError) as error:
        raise UsageError(f"labels {path}: malformed ({error}); {_SEE}") from error
    except ValueError as error:
        raise UsageError(f"labels {path}: {error}") from error


def _read(path: Path, names: Sequence[str] | None) -> OutlineLabels:
    if path.is_dir():
        files = sorted(path.glob("*.json"))
        if not files:
            raise UsageError(f"labels {path}: no JSON file in this folder")
        return from_labelme(path, {file: _json(file) for file in files}, names)
    if not path.is_file():
        raise UsageError(f"labels {path}: no such file")
    data = _json(path)
    keys = set(data) if isinstance(data, dict) else set()
    if {"images", "annotations"} <= keys:
        return from_coco(path, data, names)
    if {"shapes", "imagePath"} <= keys:
        return from_labelme(path, {path: data}, names)
    if "intrinsics" in keys:
        raise UsageError(f"labels {path}: this file holds true cameras; give the folder, {path.parent}")
    if "frames" in keys:
        return _from_contract(path, data)
    raise UsageError(f"labels {path}: no known format; known are {_KNOWN}")


def _json(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))


def _from_contract(path: Path, data: dict) -> OutlineLabels:
    frames = []
    for entry in data["frames"]:
        index, width, height = (whole(entry, key) for key in ("index", "width", "height"))
        outlines = tuple(Outline(str(t["name"]), points(t["polygon"])) for t in entry["things"])
        ignored = tuple(points(polygon) for polygon in entry.get("ignore_regions", []))
        frames.append(LabelledFrame(index, width, height, outlines, ignored))
    if "things" in data:
        things = {name: facts.get("parent") for name, facts in data["things"].items()}
        kinds = {name: facts["kind"] for name, facts in data["things"].items() if "kind" in facts}
    else:  # the file has outlines only
        things, kinds = {o.name: None for frame in frames for o in frame.outlines}, {}
    return OutlineLabels(path, tuple(frames), things, kinds, frozenset(data.get("ignore", [])))
