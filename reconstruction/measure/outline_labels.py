"""Outlines drawn by hand on frames, and their rasterization to label maps.

Pixel coordinates: x right, y down, origin at the upper left corner, pixel centers at 0.5.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

BASE_NAMES = ("floor", "wall", "ceiling")  # parents that need no outline
_MARGIN = 0.02  # of the longer side, by which polygons may exceed the image


@dataclass(frozen=True)
class Outline:
    """One polygon around the visible part of an object; several of one name in a frame are parts of one object."""

    name: str
    polygon: np.ndarray  # float64 (k, 2) pixels, k >= 3, filled even-odd


@dataclass(frozen=True)
class LabelledFrame:
    """The outlines of one frame.

    Raises:
        ValueError: a polygon has fewer than three points, or a point that is not finite or outside of the image.
    """

    index: int  # decoded video frame, or position of the image in name order, from 0
    width: int  # of the labelled image
    height: int
    outlines: tuple[Outline, ...]  # back to front: a later one covers an earlier one
    ignored: tuple[
        np.ndarray, ...
    ] = ()  # polygons (k, 2) of regions that are not evaluated; outlines cover them

    def __post_init__(self) -> None:
        if self.index < 0:
            raise ValueError(f"frame {self.index}: the index counts from 0")
        if min(self.width, self.height) < 1:
            raise ValueError(f"frame {self.index}: its size is {self.width}x{self.height}")
        for name, polygon in [(o.name, o.polygon) for o in self.outlines] + [
            ("an ignored region", polygon) for polygon in self.ignored
        ]:
            self._check(name, polygon)

    def _check(self, name: str, polygon: np.ndarray) -> None:
        where = f"frame {self.index}, {name}"
        if polygon.ndim != 2 or polygon.shape[1] != 2 or len(polygon) < 3:
            raise ValueError(
                f"{where}: a polygon needs three or more points [x, y], not shape {polygon.shape}"
            )
        if not np.isfinite(polygon).all():
            raise ValueError(f"{where}: a point is not finite")
        margin, size = _MARGIN * max(self.width, self.height), np.array([self.width, self.height])
        outside = ((polygon < -margin) | (polygon > size + margin)).any(axis=1)
        if outside.any():
            x, y = polygon[np.flatnonzero(outside)[0]]
            raise ValueError(
                f"{where}: the point ({x:g}, {y:g}) is outside of the {self.width}x{self.height} image; move it, "
                "or correct the size if the outlines were drawn on an image of another size"
            )

    def label_map(self, names: Sequence[str]) -> np.ndarray:
        """Rasterize the frame to int32 (h, w): index in `names`, len(names) = ignored, len(names) + 1 = unlabelled."""
        out = np.full((self.height, self.width), len(names) + 1, np.int32)
        for polygon in self.ignored:
            out[filled(polygon, out.shape)] = len(names)
        code = {name: number for number, name in enumerate(names)}
        for outline in self.outlines:
            out[filled(outline.polygon, out.shape)] = code[outline.name]
        return out


@dataclass(frozen=True)
class OutlineLabels:
    """All labelled frames of a capture, and the parents and kinds of the outlined objects.

    Raises:
        ValueError: a frame occurs twice, or a name or parent is not in `things`.
    """

    path: Path
    frames: tuple[LabelledFrame, ...]
    things: Mapping[str, str | None]  # name -> parent: another name, floor, wall or ceiling; None = unknown
    kinds: Mapping[str, str] = field(default_factory=dict)  # name -> object, furniture or wall_mounted
    ignore: frozenset[str] = frozenset()  # names of outlined objects that are not evaluated

    def __post_init__(self) -> None:
        if not self.frames:
            raise ValueError("no labelled frame")
        indices = [frame.index for frame in self.frames]
        for index in indices:
            if indices.count(index) > 1:
                raise ValueError(f"frame {index} is labelled twice; put all of its outlines into one")
        for frame in self.frames:
            for outline in frame.outlines:
                if outline.name not in self.things:
                    raise ValueError(f"frame {frame.index}: {outline.name!r} is not in `things`")
        for name, parent in self.things.items():
            if parent is not None and parent not in self.things and parent not in BASE_NAMES:
                raise ValueError(f"thing {name!r}: its parent {parent!r} is not in `things` nor {BASE_NAMES}")
        unknown = sorted(self.ignore - set(self.things))
        if unknown:
            raise ValueError(f"`ignore` names {unknown[0]!r}, which is not in `things`")


def filled(polygon: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Rasterize a polygon (k, 2): bool (h, w) of the pixel centers inside, by the even-odd rule."""
    from skimage.draw import polygon as inside

    out = np.zeros(shape, bool)
    out[inside(polygon[:, 1] - 0.5, polygon[:, 0] - 0.5, shape)] = True
    return out


def points(polygon: Any) -> np.ndarray:
    """Convert a polygon [[x, y], …] of a file to float64 (k, 2).

    Raises:
        ValueError: it is not a list of points.
    """
    try:
        return np.array(polygon, np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"a polygon is a list of points [x, y] ({error})") from error


def whole(entry: Mapping[str, Any], key: str) -> int:
    """Return `entry[key]` as an int.

    Raises:
        ValueError: it is not a whole number.
    """
    value = entry[key]
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not float(value).is_integer():
        raise ValueError(f"`{key}` is {value!r}, expected a whole number")
    return int(value)
