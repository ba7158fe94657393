"""The panel of one object: what is known about it, as HTML. Texts of the scene are escaped."""

import base64
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from registry.bundle import BundleObject
from registry.errors import BundleError
from registry.geometry import invert_rigid, transform_points
from studio.text import plain

if TYPE_CHECKING:
    from studio.scene_view import StudioPage

_PICTURES = 3
_PICTURE_PX = 132
_MARGIN = 0.25  # of the object's own size, around it in its pictures
_STYLE = "font-size:12.5px;line-height:1.5;padding:2px 10px;color:inherit"


def object_html(page: "StudioPage", object_id: int, share_seen: np.ndarray | None = None) -> str:
    """Return a table about an object.

    Args:
        page: the page.
        object_id: one of its objects.
        share_seen: shares (3,) of its surface that are guessed, completed and seen; None: not measured.
    """
    item = next(o for o in page.bundle.objects if o.id == object_id)
    entry = next(o for o in page.bundle.scene["objects"] if o["id"] == object_id)
    rows = "".join(
        f'<tr><td style="opacity:.6;padding:1px 10px 1px 0;vertical-align:top;white-space:nowrap">{key}</td>'
        f'<td style="padding:1px 0">{value}</td></tr>'
        for key, value in [*_facts(page, item), *_origins(item, entry, share_seen)]
    )
    sure = f"{100 * item.label_confidence:.0f} %"
    return (
        f'<div style="{_STYLE}"><div style="font-size:15px;font-weight:600">{plain(page.name_of(object_id))}</div>'
        f'<div style="opacity:.6;margin-bottom:4px">{plain(item.label)} ({sure} sure) &middot; id {item.id}</div>'
        f'<table style="border-collapse:collapse;width:100%">{rows}</table></div>'
    )


def selection_html(page: "StudioPage", ids: tuple[int, ...]) -> str:
    """Return the panel's HTML for a selection of none or several objects."""
    if not ids:
        count = len(page.bundle.objects)
        return (
            f'<div style="{_STYLE};opacity:.75">{count} objects. Click one in the room; shift-click adds another. '
            "Drag to look around, right-drag to move, scroll to come nearer.</div>"
        )
    names = ", ".join(plain(page.name_of(i)) for i in ids)
    return f'<div style="{_STYLE}"><b>{len(ids)} objects selected</b><br>{names}</div>'


def views_html(page: "StudioPage", object_id: int) -> str:
    """Return the best photographs of an object, cropped to it, as HTML with the pictures inside."""
    item = next(o for o in page.bundle.objects if o.id == object_id)
    shown = []
    for frame in item.views:
        picture = crop(page, object_id, frame)
        if picture is not None:
            shown.append((frame, picture))
        if len(shown) == _PICTURES:
            break
    if not shown:
        return f'<div style="{_STYLE};opacity:.6">Its photographs are not kept on this machine.</div>'
    cells = "".join(
        f'<figure style="margin:0;flex:1;min-width:0"><img alt="frame {frame}" '
        f'style="width:100%;height:84px;object-fit:cover;border-radius:4px;display:block" '
        f'src="data:image/jpeg;base64,{_jpeg(picture)}"></figure>'
        for frame, picture in shown
    )
    return f'<div style="{_STYLE}"><div style="display:flex;gap:6px">{cells}</div></div>'


def crop(page: "StudioPage", object_id: int, frame: int) -> np.ndarray | None:
    """Return the part of a photograph that shows an object, RGB; None: not kept, or the object is not in it."""
    if frame not in page.frames.indices:
        return None
    photograph = page.frames.photograph(frame)
    if photograph is None:
        return None
    camera_from_object = invert_rigid(page.frames.world_from_camera(frame)) @ page.pose_of(object_id)
    points = transform_points(camera_from_object, page.pickable.geometry(object_id).vertices)
    points = points[points[:, 2] > 0.05]
    if not len(points):
        return None
    cameras = page.bundle.cameras
    fx, fy, cx, cy = cameras.params[:4]
    pixels = np.column_stack([fx * points[:, 0] / points[:, 2] + cx, fy * points[:, 1] / points[:, 2] + cy])
    pixels *= np.array([photograph.shape[1] / cameras.width, photograph.shape[0] / cameras.height])
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    margin = _MARGIN * (high - low).max()
    left, top = np.maximum(low - margin, 0).astype(int)
    right, bottom = np.minimum(high + margin, photograph.shape[1::-1]).astype(int)
    return photograph[top:bottom, left:right] if right - left > 4 and bottom - top > 4 else None


def _facts(page: "StudioPage", item: BundleObject) -> list[tuple[str, str]]:
    scale = page.bundle.scene["scale"]
    sigma = scale.get("uncertainty") or 0.0
    size = " &times; ".join(f"{100 * x:.1f}" for x in item.scale)
    out = [
        (
            "Size",
            f"{size} cm"
            + (f' <span style="opacity:.6">&plusmn; {100 * sigma:.0f} %</span>' if sigma else ""),
        )
    ]
    out.append(("Mass", _ranged(item.mass_kg, item.ranges.get("mass_kg"), _kilograms)))
    out.append(("Material", f"{plain(item.material)}, {item.density_kg_m3:.0f} kg/m³"))
    out.append(("Friction", _ranged(item.friction, item.ranges.get("friction"), lambda x: f"{x:.2f}")))
    edge = next(e for e in page.bundle.edges if e.child == item.id)
    relation = "hangs on" if edge.relation == "attached_to" else "stands on"
    moves = "movable" if item.dynamic else "fixed"
    out.append(
        ("Support", f"{relation} <b>{plain(page.name_of(edge.parent))}</b> ({100 * edge.confidence:.0f} %)")
    )
    out.append(("", f'<span style="opacity:.6">{plain(edge.evidence)}</span>'))
    carried = [plain(page.name_of(e.child)) for e in page.bundle.edges if e.parent == item.id]
    if carried:
        out.append(("Carries", ", ".join(carried)))
    out.append(("Motion", f"{moves}, {len(item.collision)} collision parts"))
    return out


def _origins(
    item: BundleObject, entry: dict[str, Any], share_seen: np.ndarray | None
) -> list[tuple[str, str]]:
    seen = float(item.provenance["observed_fraction"])
    bar = (
        '<div style="height:5px;border-radius:3px;background:rgba(128,128,128,.25);margin:3px 0 2px">'
        f'<div style="height:5px;border-radius:3px;background:#3e9688;width:{100 * seen:.0f}%"></div></div>'
    )
    text = f"{100 * seen:.0f} % of its surface{bar}"
    if share_seen is not None:
        guessed, completed, measured = (100 * float(x) for x in share_seen)
        text += (
            f'<span style="opacity:.6">depth: {measured:.0f} % measured, {completed:.0f} % completed, '
            f"{guessed:.0f} % guessed</span>"
        )
    out = [("Seen", text), ("Shape", plain(item.provenance["geometry"]))]
    assembly = entry.get("assembly", {})
    if assembly.get("repair"):
        out.append(("Repair", plain(assembly["repair"])))
    if not assembly.get("stable", True):
        out.append(("Rest", '<b style="color:#d66853">does not rest</b>'))
    return out


def _ranged(value: float, span: tuple[float, float] | None, show: Any) -> str:
    if span is None:
        return show(value)
    return f'{show(value)} <span style="opacity:.6">({show(span[0])} to {show(span[1])})</span>'


def _kilograms(mass: float) -> str:
    return f"{mass:.2f} kg" if mass >= 0.1 else f"{1000 * mass:.0f} g"


def _jpeg(picture: np.ndarray) -> str:
    scale = _PICTURE_PX * 2 / max(picture.shape[:2])
    if scale < 1:
        size = (max(1, round(picture.shape[1] * scale)), max(1, round(picture.shape[0] * scale)))
        picture = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    done, data = cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 82])
    if not done:
        raise BundleError("a photograph cannot be encoded as JPEG")
    return base64.b64encode(data.tobytes()).decode()
