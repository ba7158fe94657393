"""Draw contact sheets of a scene: frames with outlined, numbered objects and a legend, and a crop of each object.

All data is in the bundle's `instances/` (`reconstruction.publish.instance_views`).
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from reconstruction.measure.report import drawing
from registry import SceneBundle
from registry.errors import BundleError, UsageError

FRAME_PX = 1120
_ROW_PX, _TILE_PX, _COLUMNS = 21, 270, 4
_INK, _FAINT = (28, 31, 36), (104, 110, 120)
_WORD_CHARACTERS = 22  # longest label
_CROWDED = 14  # objects in a frame, above which only numbers are drawn


@dataclass(frozen=True)
class SheetFrame:
    """A video frame with its id map."""

    index: int
    image: np.ndarray  # uint8 (h, w, 3)
    ids: np.ndarray  # uint16 (h', w') object ids, 0 = none


@dataclass(frozen=True)
class ContactSheet:
    """The data of the sheets of one scene."""

    scene: dict
    frames: tuple[SheetFrame, ...]

    @classmethod
    def of(cls, bundle: SceneBundle) -> "ContactSheet":
        """Read the frames of a bundle.

        Raises:
            UsageError: the bundle has none, as it was written by an older version.
            BundleError: an image is damaged.
        """
        if "instances" not in bundle.scene:
            raise UsageError(
                f"{bundle.scene['id']}: its bundle holds no frames for contact sheets; run its `simrecon reconstruct` "
                "command again (cached stages are reused)"
            )
        return cls.read(bundle.scene, bundle.resolve)

    @classmethod
    def read(cls, scene: dict, resolve: Callable[[str], Path]) -> "ContactSheet":
        """Read the frames listed in `instances.frames` of a scene; `resolve` maps their names to paths.

        Raises:
            BundleError: an image is damaged.
        """
        frames = []
        for entry in scene["instances"]["frames"]:
            image = cv2.imread(str(resolve(entry["image"])), cv2.IMREAD_COLOR)
            ids = cv2.imread(str(resolve(entry["ids"])), cv2.IMREAD_UNCHANGED)
            if image is None or ids is None or ids.ndim != 2:
                raise BundleError(
                    f"{scene['id']}: {entry['image']} or {entry['ids']} cannot be read as an image"
                )
            frames.append(SheetFrame(entry["index"], image[..., ::-1].copy(), ids.astype(np.uint16)))
        return cls(scene, tuple(frames))

    @cached_property
    def objects(self) -> dict[int, dict]:
        """The objects of the scene by id, ascending."""
        return {item["id"]: item for item in sorted(self.scene["objects"], key=lambda o: o["id"])}

    @cached_property
    def colors(self) -> dict[int, tuple[int, int, int]]:
        """One color per object id, the same as in the report."""
        return {number: drawing.object_color(rank) for rank, number in enumerate(self.objects)}

    def shown_in(self, frame: SheetFrame) -> list[int]:
        """Return the ids of the objects visible in a frame."""
        return [int(n) for n in np.unique(frame.ids) if int(n) in self.objects]

    def frame_of(self, number: int) -> SheetFrame | None:
        """Return the frame with an object's anchor; None if no frame shows it."""
        anchor = self.objects[number].get("anchor")
        return next((f for f in self.frames if anchor and f.index == anchor["frame"]), None)

    def facts(self, number: int) -> tuple[str, str, str, str]:
        """Return label, confidence, size and support of an object as text."""
        item = self.objects[number]
        names = {e["id"]: e["label"] for e in (*self.scene["base"], *self.scene["objects"])}
        edge = next((e for e in self.scene["graph"]["edges"] if e["child"] == number), None)
        how = {"supported_by": "on", "attached_to": "fixed to"}
        held = f"{how[edge['relation']]} {shortened(names[edge['parent']])} {edge['parent']}" if edge else ""
        size = " x ".join(f"{100 * side:.0f}" for side in item["scale"]) + " cm"
        sure = "" if item["label"] == "unknown" else f"{item['label_confidence']:.0%}"
        return shortened(item["label"]), sure, size, held


def shortened(label: str) -> str:
    """Truncate a label to fit a legend."""
    return label if len(label) <= _WORD_CHARACTERS else label[: _WORD_CHARACTERS - 1].rstrip() + "…"


def anchor_text(item: dict) -> str:
    """Return the address of an object for an overrides file: its anchor pixel, or its id without an anchor."""
    anchor = item.get("anchor")
    if anchor is None:
        return f"id: {item['id']}"
    return f"pixel: {{frame: {anchor['frame']}, x: {anchor['x']:g}, y: {anchor['y']:g}}}"


def frame_picture(sheet: ContactSheet, frame: SheetFrame) -> np.ndarray:
    """Draw a frame with its objects outlined, numbered and, unless crowded, named; the longer side is FRAME_PX."""
    height, width = frame.image.shape[:2]
    scale = FRAME_PX / max(height, width)
    size = (round(width * scale), round(height * scale))
    image = cv2.resize(frame.image, size, interpolation=cv2.INTER_CUBIC if scale > 1 else cv2.INTER_AREA)
    shown = sheet.shown_in(frame)
    words = {n: str(n) if len(shown) > _CROWDED else f"{n} {sheet.facts(n)[0]}" for n in shown}
    colors = {n: sheet.colors[n] for n in shown}
    return drawing.outlined(image, frame.ids, colors, words, tint=0.2, smallest=0.0)


def frame_sheet(sheet: ContactSheet, frame: SheetFrame) -> np.ndarray:
    """Draw a frame (`frame_picture`) with a legend to its right: uint8 (h, w, 3).

    The frame starts in the upper left corner, so that its pixel coordinates are those of the sheet.
    """
    picture = frame_picture(sheet, frame)
    height, width = picture.shape[:2]
    legend = _legend(sheet, frame, sheet.shown_in(frame), max(height, 200), (width, height))
    out = np.full((max(height, legend.shape[0]), width + legend.shape[1], 3), 255, np.uint8)
    out[:height, :width] = picture
    out[: legend.shape[0], width:] = legend
    return out


def _legend(
    sheet: ContactSheet, frame: SheetFrame, shown: list[int], least_px: int, size: tuple[int, int]
) -> np.ndarray:
    rows = [(n, *sheet.facts(n)) for n in shown]
    bold, plain, small = drawing.font(14), drawing.font(14, ""), drawing.font(11, "")
    columns = [18 + 14 * 2, *(_max_width([str(r[k]) for r in rows], plain) for k in range(1, 5))]
    lefts = 16 + np.cumsum([0, *(c + 14 for c in columns)])
    note = f"clicks counted in this picture: size: [{size[0]}, {size[1]}]"
    wide = int(max(lefts[-1] + 4, 32 + plain.getlength(note)))
    image = Image.new("RGB", (wide, max(least_px, 64 + _ROW_PX * len(rows))), (255, 255, 255))
    draw = ImageDraw.Draw(image)
    draw.text((16, 10), f"{sheet.scene['id']}, frame {frame.index}", font=bold, fill=_INK)
    draw.text((16, 31), note, font=small, fill=_FAINT)
    for k, (number, *words) in enumerate(rows):
        y = 64 + _ROW_PX * k
        draw.rounded_rectangle((16, y - 8, 28, y + 4), 3, fill=sheet.colors[number])
        draw.text((34, y - 2), str(number), font=bold, fill=_INK, anchor="lm")
        for left, word, ink in zip(lefts[1:], words, (_INK, _FAINT, _FAINT, _INK)):
            draw.text((left, y - 2), word, font=plain, fill=ink, anchor="lm")
    return np.asarray(image)


def _max_width(words: list[str], font: ImageFont.FreeTypeFont) -> int:
    return int(max((font.getlength(word) for word in words), default=0))


def crops_sheet(sheet: ContactSheet, columns: int = _COLUMNS) -> np.ndarray:
    """Draw a grid of object crops from their best frames, with facts: uint8 (h, w, 3).

    Raises:
        UsageError: the scene has no objects.
    """
    tiles = [_tile(sheet, number) for number in sheet.objects]
    if not tiles:
        raise UsageError(f"{sheet.scene['id']}: this scene has no objects; there is nothing to show")
    blank = np.full_like(tiles[0], 255)
    columns = min(columns, len(tiles))
    tiles += [blank] * (-len(tiles) % columns)
    return np.vstack([np.hstack(tiles[k : k + columns]) for k in range(0, len(tiles), columns)])


def _tile(sheet: ContactSheet, number: int) -> np.ndarray:
    frame, item = sheet.frame_of(number), sheet.objects[number]
    label, confidence, size, held = sheet.facts(number)
    side = _TILE_PX - 12
    image = Image.new("RGB", (_TILE_PX, _TILE_PX + 66), (255, 255, 255))
    if frame is not None:
        image.paste(Image.fromarray(crop(frame, number, sheet.colors[number], side)), (6, 6))
    draw = ImageDraw.Draw(image)
    bold, plain, small = drawing.font(14), drawing.font(13, ""), drawing.font(11, "")
    draw.rounded_rectangle((6, side + 14, 18, side + 26), 3, fill=sheet.colors[number])
    draw.text((24, side + 20), f"{number} {label}", font=bold, fill=_INK, anchor="lm")
    draw.text((side + 6, side + 20), confidence, font=plain, fill=_FAINT, anchor="rm")
    draw.text((6, side + 39), f"{size}, {held}", font=plain, fill=_INK, anchor="lm")
    words = anchor_text(item) if frame else "in no keyframe"
    draw.text((6, side + 57), words, font=small, fill=_FAINT, anchor="lm")
    return np.asarray(image)


def crop(frame: SheetFrame, number: int, color: tuple[int, int, int], side: int) -> np.ndarray:
    """Crop a frame around one object, with its outline: (side, side, 3)."""
    height, width = frame.image.shape[:2]
    mask = (frame.ids == number).astype(np.uint8)
    mask = cv2.resize(mask, (width, height), interpolation=cv2.INTER_NEAREST)
    rows, columns = np.nonzero(mask)
    low = np.array([columns.min(), rows.min()])
    high = np.array([columns.max(), rows.max()]) + 1
    half = int(max(0.68 * (high - low).max(), 24))
    x, y = ((low + high) // 2 - half).tolist()
    pad = ((max(0, -y), max(0, y + 2 * half - height)), (max(0, -x), max(0, x + 2 * half - width)))
    window = (slice(max(y, 0), y + 2 * half), slice(max(x, 0), x + 2 * half))
    image = np.pad(frame.image[window], (*pad, (0, 0)), constant_values=236)
    mask = np.pad(mask[window], pad)
    method = cv2.INTER_CUBIC if side > 2 * half else cv2.INTER_AREA
    big = cv2.resize(image, (side, side), interpolation=method)
    smooth = cv2.resize(mask * 255, (side, side), interpolation=cv2.INTER_LINEAR)
    contours, _ = cv2.findContours((smooth > 127).astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    big = np.ascontiguousarray(big)
    cv2.drawContours(big, contours, -1, (255, 255, 255), 3, cv2.LINE_AA)
    cv2.drawContours(big, contours, -1, color, 2, cv2.LINE_AA)
    return big
