"""Draw Set-of-Mark pictures: each object outlined in its own color, with a label that hides no other object."""

from collections.abc import Mapping

import cv2
import numpy as np

from reconstruction.core.rasterize import rasterize_mesh
from reconstruction.core.types import AssetSet, Camera
from registry.geometry import transform_points

_FONT = cv2.FONT_HERSHEY_SIMPLEX
_RINGS = (0.0, 1.0, 1.5, 2.2, 3.0, 4.0, 5.5, 7.5)  # distances of a label from its object, in label heights
_DIRECTIONS = 16  # label positions on each ring
_SPECK = 5e-5  # share of the picture; smaller parts and holes of an object get no outline


def id_map(assets: AssetSet, camera: Camera, world_from_camera: np.ndarray) -> np.ndarray:
    """Render the ids of the visible assets, base and structure included: int32 (h, w), 0 = none."""
    meshes = [(b.id, np.asarray(b.visual.vertices), b.visual.faces) for b in assets.base]
    if assets.structure is not None:
        visual = assets.structure.visual
        meshes += [(assets.structure.id, np.asarray(visual.vertices), visual.faces)]
    for o in assets.objects:
        meshes += [(o.id, transform_points(o.world_from_object, o.visual.vertices), o.visual.faces)]
    starts = np.cumsum([0] + [len(vertices) for _, vertices, _ in meshes])
    vertices = np.concatenate([vertices for _, vertices, _ in meshes])
    faces = np.concatenate([np.asarray(f) + start for (_, _, f), start in zip(meshes, starts)])
    owner = np.repeat([number for number, _, _ in meshes], [len(f) for _, _, f in meshes])
    face = rasterize_mesh(vertices, faces, camera, world_from_camera).face
    return np.where(face >= 0, owner[np.maximum(face, 0)], 0).astype(np.int32)


def number_things(
    picture: np.ndarray, ids: np.ndarray, things: Mapping[int, str], base: Mapping[int, str]
) -> np.ndarray:
    """Draw outlines and labels into a copy of a picture uint8 (h, w, 3) RGB.

    Labels stand on their object if it is large enough, else beside it with a leader line. They do not overlap as long
    as there is room.

    Args:
        picture: the view.
        ids: its id map, int (h, w).
        things: label by id of the objects, which are outlined.
        base: label by id of base surfaces, which are not outlined.
    """
    out = np.ascontiguousarray(picture).copy()
    scale = max(min(picture.shape[:2]) / 768, 0.5)
    for number in things:
        smooth = cv2.medianBlur((ids == number).astype(np.uint8), 3)
        contours, _ = cv2.findContours(smooth, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
        contours = [c for c in contours if len(contours) == 1 or cv2.contourArea(c) > _SPECK * ids.size]
        cv2.drawContours(out, contours, -1, (255, 255, 255), max(round(4 * scale), 2), cv2.LINE_AA)
        cv2.drawContours(out, contours, -1, color_of(number), max(round(2 * scale), 1), cv2.LINE_AA)
    taken = np.zeros(ids.shape, bool)
    area = {number: int((ids == number).sum()) for number in [*things, *base]}
    # Small objects first: large ones have more places for their labels.
    order = [n for labels in (things, base) for n in sorted(labels, key=lambda n: (area[n], n))]
    pills = [_place(n, (things if n in things else base)[n], ids, taken, area, scale) for n in order]
    for number, anchor, box, _ in pills:
        end = (int(np.clip(anchor[0], box[0], box[2])), int(np.clip(anchor[1], box[1], box[3])))
        if end != anchor:
            color = color_of(number) if number in things else (250, 250, 250)
            cv2.line(out, anchor, end, (20, 20, 20), max(round(4 * scale), 2), cv2.LINE_AA)
            cv2.line(out, anchor, end, color, max(round(2 * scale), 1), cv2.LINE_AA)
            cv2.circle(out, anchor, max(round(4 * scale), 2), color, -1, cv2.LINE_AA)
    for number, _, box, text in pills:
        _draw_label(out, text, box, color_of(number) if number in things else (250, 250, 250), scale)
    return out


def color_of(number: int) -> tuple[int, int, int]:
    """Return a saturated color (r, g, b) for an id; consecutive ids are far apart in hue."""
    hsv = np.array([[[int(179 * ((0.07 + number * 0.381966) % 1.0)), 190, 250]]], np.uint8)
    r, g, b = cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB)[0, 0].tolist()
    return r, g, b


def _text_size(text: str, scale: float) -> tuple[int, int]:
    (width, height), base = cv2.getTextSize(text, _FONT, 0.8 * scale, max(round(2 * scale), 1))
    return width + round(10 * scale), height + base + round(6 * scale)


def _place(
    number: int, text: str, ids: np.ndarray, taken: np.ndarray, area: Mapping[int, int], scale: float
) -> tuple[int, tuple[int, int], tuple[int, int, int, int], str]:
    """Place a label: near its object, on no other label, hiding as little as possible of other objects.

    Returns:
        The id, the anchor pixel (x, y) in the object, the box (left, top, right, bottom), the text.
    """
    mask = ids == number
    inner = cv2.distanceTransform(np.pad(mask.astype(np.uint8), 1), cv2.DIST_L2, 3)[1:-1, 1:-1]
    y, x = map(int, np.unravel_index(int(np.argmax(np.where(taken, 0, inner))), inner.shape))
    wide, tall = _text_size(text, scale)
    best, best_cost = None, np.inf
    for ring in _RINGS:
        for k in range(_DIRECTIONS if ring else 1):
            turn = 2 * np.pi * k / _DIRECTIONS
            cx = x + np.cos(turn) * (ring * tall + 0.5 * (wide - tall) * min(ring, 1))
            cy = y + np.sin(turn) * ring * tall
            left, top = round(cx - wide / 2), round(cy - tall / 2)
            if left < 1 or top < 1 or left + wide >= ids.shape[1] or top + tall >= ids.shape[0]:
                continue
            window = np.s_[top : top + tall, left : left + wide]
            under = ids[window]
            others = [other for other in np.unique(under) if area.get(int(other))]
            hidden = sum(np.count_nonzero(under == other) / area[other] for other in others)
            cost = ring + 12 * float(hidden) + 100 * float(taken[window].mean() > 0)
            if cost < best_cost:
                best, best_cost = (left, top, left + wide, top + tall), cost
    if best is None:  # the picture is hardly larger than the label
        best = (0, 0, wide, tall)
    taken[max(best[1] - 2, 0) : best[3] + 2, max(best[0] - 2, 0) : best[2] + 2] = True
    return number, (x, y), best, text


def _draw_label(
    out: np.ndarray, text: str, box: tuple[int, int, int, int], color: tuple[int, int, int], scale: float
) -> None:
    left, top, right, bottom = box
    cv2.rectangle(out, (left, top), (right, bottom), color, -1)
    cv2.rectangle(out, (left, top), (right, bottom), (20, 20, 20), 1)
    thick = max(round(2 * scale), 1)
    (width, height), _ = cv2.getTextSize(text, _FONT, 0.8 * scale, thick)
    at = ((left + right - width) // 2, (top + bottom + height) // 2)
    cv2.putText(out, text, at, _FONT, 0.8 * scale, (0, 0, 0), thick, cv2.LINE_AA)
