"""Draw contact sheets of the stage `views`: the views of each object, and below each the view without occluders."""

from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
from PIL import Image, ImageDraw

from reconstruction.measure.report import drawing
from reconstruction.measure.report.contact_page import save_picture
from reconstruction.views import SceneViews, View

_TILE_PX, _GAP_PX, _CAPTION_PX, _TITLE_PX = 220, 8, 20, 28
_ROWS = 6  # objects per sheet
_INK, _FAINT, _LINE = (28, 31, 36), (104, 110, 120), (255, 40, 160)


def write_view_sheets(views: SceneViews, names: Mapping[int, str], folder: Path) -> list[Path]:
    """Write `views_01.jpg` and so on, with six objects each; return their paths. Deterministic.

    Args:
        views: result of the stage.
        names: name of each object by id.
        folder: created if missing.
    """
    folder.mkdir(parents=True, exist_ok=True)
    width = max((len(target.views) for target in views.targets), default=0)
    rows = [
        _object_row(f"{target.ids[0]} {names.get(target.ids[0], '')}", target.views, width)
        for target in views.targets
    ]
    written = []
    for number, first in enumerate(range(0, len(rows), _ROWS), start=1):
        written.append(folder / f"views_{number:02d}.jpg")
        save_picture(np.concatenate(rows[first : first + _ROWS]), written[-1])
    return written


def _object_row(title: str, views: tuple[View, ...], columns: int) -> np.ndarray:
    """Draw the views of one object side by side: uint8 (h, w, 3)."""
    width = max(_GAP_PX + columns * (_TILE_PX + _GAP_PX), 460)
    height = _TITLE_PX + (2 * _TILE_PX + _CAPTION_PX + 2 * _GAP_PX if views else _CAPTION_PX)
    image = Image.new("RGB", (width, height), (255, 255, 255))
    draw = ImageDraw.Draw(image)
    draw.text((_GAP_PX, _TITLE_PX // 2), title, font=drawing.font(15), fill=_INK, anchor="lm")
    if not views:
        words = "not visible from any point in free space"
        draw.text((_GAP_PX, _TITLE_PX + 8), words, font=drawing.font(12, ""), fill=_FAINT, anchor="lm")
    for column, view in enumerate(views):
        left = _GAP_PX + column * (_TILE_PX + _GAP_PX)
        caption = f"{view.visibility:.0%} visible, {view.gain:.0%} new" + (
            "" if view.fronts > 0.5 else ", from behind"
        )
        draw.text((left, _TITLE_PX + 8), caption, font=drawing.font(12, ""), fill=_FAINT, anchor="lm")
        top = _TITLE_PX + _CAPTION_PX
        image.paste(Image.fromarray(_outlined(view.color, view.mask)), (left, top))
        image.paste(Image.fromarray(_outlined(view.clean, view.outline)), (left, top + _TILE_PX + _GAP_PX))
    return np.asarray(image)


def _outlined(picture: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Resize an image to a tile uint8 (_TILE_PX, _TILE_PX, 3) and outline a mask."""
    scale = _TILE_PX / max(picture.shape[:2])
    size = (round(picture.shape[1] * scale), round(picture.shape[0] * scale))
    small = cv2.resize(picture, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC)
    smooth = cv2.resize(mask.astype(np.uint8) * 255, size, interpolation=cv2.INTER_LINEAR)
    edges, _ = cv2.findContours((smooth > 127).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    small = cv2.drawContours(np.ascontiguousarray(small), edges, -1, _LINE, 2, cv2.LINE_AA)
    out = np.full((_TILE_PX, _TILE_PX, 3), 236, np.uint8)
    top, left = (_TILE_PX - size[1]) // 2, (_TILE_PX - size[0]) // 2
    out[top : top + size[1], left : left + size[0]] = small
    return out
