"""Generate referring expressions: a unique noun phrase per object, such as "small red box on the shelf".

The incremental algorithm (Dale and Reiter, Cognitive Science 1995): attributes are tried in a fixed order; one is
used if it excludes another object. Color is used whenever it is certain. The noun is the label, or the shape of
objects without one.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from reconstruction.core.mesh_graph import lab_from_rgb
from reconstruction.core.types import TexturedMesh
from reconstruction.instances.labels import UNKNOWN

_HUES = (  # upper end of the CIELAB hue angle in degrees, light name, dark name
    (48.0, "pink", "red"),
    (75.0, "orange", "brown"),
    (110.0, "yellow", "brown"),
    (195.0, "green", "green"),
    (300.0, "blue", "blue"),
    (335.0, "purple", "purple"),
    (360.0, "pink", "purple"),
)
_LIGHT_FROM = 58.0  # CIELAB lightness from which the light name of a hue applies
_VIVID, _DULL = (
    50.0,
    25.0,
)  # chroma: light reds from the first are not pink, dark reds below the second are brown
# Least chroma of a color that is not black, gray or white: a share of the lightness, clipped to two bounds.
_COLORED_SHARE, _COLORED_LOW, _COLORED_HIGH = 0.25, 7.0, 12.0
_BLACK_BELOW, _WHITE_FROM = 22.0, 68.0  # lightness of achromatic surfaces
_SURE_SHARE = 0.5  # least share of the area with one color name
_BOX_FILL = 0.88  # least volume of the convex hull over that of the bounding box
_ROUND_FILL = (0.74, 0.84)  # footprint: area of the convex hull over that of the bounding box
_FLAT, _TALL, _LONG = (
    0.22,
    1.8,
    3.0,
)  # height / shorter side, height / longer side, longer side / shorter side
_LARGER = 1.4  # ratio of volumes from which sizes count as different
_BESIDE_M = 0.4  # largest distance of centers for "beside"


@dataclass(frozen=True)
class Described:
    """The attributes of one object that a phrase may use."""

    id: int
    noun: str  # its label, or its shape
    color: str  # "" if uncertain
    volume: float  # of its bounding box, m3
    center: np.ndarray  # float64 (3,) world, metres
    parent: int

    @classmethod
    def of(
        cls, key: int, label: str, mesh: TexturedMesh, world_from_object: np.ndarray, parent: int
    ) -> "Described":
        """Measure the attributes of an object; `parent` is the id of its support."""
        low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
        center = world_from_object[:3, :3] @ (0.5 * (low + high)) + world_from_object[:3, 3]
        noun = label.replace("_", " ") if label != UNKNOWN[0] else shape_noun(mesh.vertices)
        return cls(key, noun, color_name(mesh), float(np.prod(high - low)), center, parent)


def phrases(objects: Sequence[Described], base_labels: Mapping[int, str]) -> dict[int, str]:
    """Return a unique noun phrase per object id, without article.

    Args:
        objects: all objects of a scene.
        base_labels: id -> "floor", "wall" or "ceiling".
    """
    every = {item.id: item for item in objects}
    short = {item.id: _short(item, objects) for item in objects}
    out = {}
    for item in objects:
        text = short[item.id]
        alike = [other for other in objects if other.id != item.id and short[other.id] == text]
        if alike:
            text = _with_place(item, alike, every, short, base_labels) or f"{text} {item.id}"
        out[item.id] = text
    taken: dict[str, int] = {}
    for key, text in sorted(out.items()):  # labels are free text: one may equal the phrase of another object
        out[key] = text if text not in taken else f"{text} {key}"
        taken.setdefault(text, key)
    return out


def _short(item: Described, objects: Sequence[Described]) -> str:
    """Return color and noun, with the size if all objects of that color and noun are clearly smaller or larger."""
    shape, _, noun = item.noun.rpartition(" ") if item.noun.endswith(" thing") else ("", "", item.noun)
    words = [word for word in (shape, item.color, noun) if word]
    alike = [o for o in objects if o.id != item.id and (o.color, o.noun) == (item.color, item.noun)]
    if alike and all(item.volume > _LARGER * o.volume for o in alike):
        words.insert(0, "large")
    elif alike and all(_LARGER * item.volume < o.volume for o in alike):
        words.insert(0, "small")
    return " ".join(words)


def _with_place(
    item: Described, alike: Sequence[Described], every: Mapping[int, Described], short: Mapping[int, str],
    base_labels: Mapping[int, str],
) -> str:  # fmt: skip
    """Append a support or a landmark that excludes all of `alike`; "" if there is none."""
    counts: dict[str, int] = {}
    for text in short.values():
        counts[text] = counts.get(text, 0) + 1
    supports = {o.id: base_labels.get(o.parent) or short.get(o.parent, "") for o in (item, *alike)}
    support = supports.pop(item.id)
    if support and support not in supports.values() and counts.get(support, 1) == 1:
        return f"{short[item.id]} on the {support}"
    landmarks = [o for o in every.values() if counts[short[o.id]] == 1 and o.id not in (item.id, item.parent)]
    for mark in sorted(landmarks, key=lambda o: (_distance(item, o), o.id)):
        if _distance(item, mark) > _BESIDE_M:
            break
        if mark.parent != item.id and all(_distance(o, mark) > 1.5 * _distance(item, mark) for o in alike):
            return f"{short[item.id]} beside the {short[mark.id]}"
    return ""


def _distance(a: Described, b: Described) -> float:
    return float(np.linalg.norm(a.center - b.center))


def shape_noun(vertices: np.ndarray) -> str:
    """Classify vertices (v, 3), +z up, as "box", "round", "flat", "tall" or "long thing", or "thing"."""
    from scipy.spatial import ConvexHull, QhullError

    size = np.ptp(vertices, axis=0).astype(np.float64)
    across = np.sort(size[:2])
    try:
        fill = ConvexHull(vertices).volume / max(float(np.prod(size)), 1e-12)
        outline = ConvexHull(vertices[:, :2]).volume / max(float(np.prod(size[:2])), 1e-12)
    except QhullError:
        return "flat thing"
    if size[2] < _FLAT * across[0]:
        return "flat thing"
    if fill >= _BOX_FILL:
        return "box"
    if size[2] > _TALL * across[1]:
        return "tall thing"
    if across[1] > _LONG * across[0]:
        return "long thing"
    round_outline = _ROUND_FILL[0] <= outline <= _ROUND_FILL[1] and across[1] < 1.2 * across[0]
    return "round thing" if round_outline else "thing"


def color_name(mesh: TexturedMesh) -> str:
    """Return the color name of most of a mesh's textured area, "" if none covers half of it."""
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    uv = mesh.uvs[mesh.faces].mean(axis=1)
    rows, columns = mesh.texture.shape[:2]
    row = np.clip(((1.0 - uv[:, 1]) * rows).astype(int), 0, rows - 1)
    column = np.clip((uv[:, 0] * columns).astype(int), 0, columns - 1)
    names, place = np.unique(_names_of(lab_from_rgb(mesh.texture[row, column])), return_inverse=True)
    if not len(names) or area.sum() <= 0:
        return ""
    share = np.bincount(place, weights=area) / area.sum()
    return str(names[share.argmax()]) if share.max() >= _SURE_SHARE else ""


def _names_of(lab: np.ndarray) -> np.ndarray:
    """Map CIELAB colors (n, 3) to basic color terms (n,)."""
    light, chroma = lab[:, 0], np.hypot(lab[:, 1], lab[:, 2])
    hue = np.degrees(np.arctan2(lab[:, 2], lab[:, 1])) % 360.0
    row = np.searchsorted([end for end, _, _ in _HUES], hue, side="right").clip(max=len(_HUES) - 1)
    bright, dark = (np.array([entry[k] for entry in _HUES])[row] for k in (1, 2))
    named = np.where((light >= _LIGHT_FROM) & ((bright != "pink") | (chroma < _VIVID)), bright, dark)
    named = np.where((named == "red") & (chroma < _DULL), "brown", named)
    plain = np.where(light < _BLACK_BELOW, "black", np.where(light >= _WHITE_FROM, "white", "gray"))
    colored = chroma >= np.clip(_COLORED_SHARE * light, _COLORED_LOW, _COLORED_HIGH)
    return np.where(colored & (light >= 0.5 * _BLACK_BELOW), named, plain)
