"""Referring expressions: objects of a scene -> noun phrases that tell them apart, such as "small red box on the shelf".

The incremental algorithm (Dale & Reiter, Cognitive Science 1995): attributes are tried in a fixed order, and one is
taken where it rules out another object. Color is taken wherever it is sure, as people do. Phrases say what was
measured: the label where there is one, else the shape.
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
_LIGHT_FROM = 58.0  # lightness that parts the light from the dark name of a hue
_VIVID, _DULL = 50.0, 25.0  # chroma from which a light red is no pink, and below which a dark red is brown
_COLORED_SHARE, _COLORED_LOW, _COLORED_HIGH = 0.25, 7.0, 12.0  # chroma over lightness, and its bounds
_BLACK_BELOW, _WHITE_FROM = 22.0, 68.0  # lightness of surfaces without chroma
_SURE_SHARE = 0.5  # of the area must have the color's name
_BOX_FILL, _ROUND_FILL = (
    0.88,
    (0.74, 0.84),
)  # hull over box volume; hull over box area of the outline from above
_FLAT, _TALL, _LONG = 0.22, 1.8, 3.0  # height over the smaller side, height over the larger, side over side
_LARGER = 1.4  # ratio of volumes from which sizes differ visibly
_BESIDE_M = 0.4


@dataclass(frozen=True)
class Described:
    """The facts of one object that a phrase may use."""

    id: int
    noun: str  # its label, or its shape
    color: str  # "" where it is not sure
    volume: float  # of its box, m3
    center: np.ndarray  # float64 (3,) world, metres
    parent: int

    @classmethod
    def of(
        cls, key: int, label: str, mesh: TexturedMesh, world_from_object: np.ndarray, parent: int
    ) -> "Described":
        """Measure an object."""
        low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
        center = world_from_object[:3, :3] @ (0.5 * (low + high)) + world_from_object[:3, 3]
        noun = label.replace("_", " ") if label != UNKNOWN[0] else shape_noun(mesh.vertices)
        return cls(key, noun, color_name(mesh), float(np.prod(high - low)), center, parent)


def phrases(objects: Sequence[Described], base_labels: Mapping[int, str]) -> dict[int, str]:
    """Return a noun phrase for each object by id, without article, no two alike.

    Args:
        objects: All objects of a scene.
        base_labels: "floor", "wall" or "ceiling" by id.
    """
    every = {item.id: item for item in objects}
    short = {item.id: _short(item, objects) for item in objects}
    out = {}
    for item in objects:
        alike = [other for other in objects if other.id != item.id and short[other.id] == short[item.id]]
        text = short[item.id]
        if alike:
            text = _placed(item, alike, every, short, base_labels) or f"{text} {item.id}"
        out[item.id] = text
    taken: dict[str, int] = {}
    for key, text in sorted(out.items()):  # labels are free words: one may read like another thing's place
        out[key] = text if text not in taken else f"{text} {key}"
        taken.setdefault(text, key)
    return out


def _short(item: Described, objects: Sequence[Described]) -> str:
    """Return color and noun, with the size where others share both and all of them are visibly smaller or larger."""
    shape, _, noun = item.noun.rpartition(" ") if item.noun.endswith(" thing") else ("", "", item.noun)
    words = [word for word in (shape, item.color, noun) if word]
    alike = [o for o in objects if o.id != item.id and (o.color, o.noun) == (item.color, item.noun)]
    if alike and all(item.volume > _LARGER * o.volume for o in alike):
        words.insert(0, "large")
    elif alike and all(_LARGER * item.volume < o.volume for o in alike):
        words.insert(0, "small")
    return " ".join(words)


def _placed(
    item: Described, alike: Sequence[Described], every: Mapping[int, Described], short: Mapping[int, str],
    base_labels: Mapping[int, str],
) -> str:  # fmt: skip
    """Return the phrase with a place that none of those that read alike has, "" where there is none."""
    counts: dict[str, int] = {}
    for text in short.values():
        counts[text] = counts.get(text, 0) + 1
    carriers = {o.id: base_labels.get(o.parent) or short.get(o.parent, "") for o in (item, *alike)}
    carrier = carriers.pop(item.id)
    if carrier and carrier not in carriers.values() and counts.get(carrier, 1) == 1:
        return f"{short[item.id]} on the {carrier}"
    landmarks = [o for o in every.values() if counts[short[o.id]] == 1 and o.id not in (item.id, item.parent)]
    for mark in sorted(landmarks, key=lambda o: (_apart(item, o), o.id)):
        if _apart(item, mark) > _BESIDE_M:
            break
        if mark.parent != item.id and all(_apart(o, mark) > 1.5 * _apart(item, mark) for o in alike):
            return f"{short[item.id]} beside the {short[mark.id]}"
    return ""


def _apart(a: Described, b: Described) -> float:
    return float(np.linalg.norm(a.center - b.center))


def shape_noun(vertices: np.ndarray) -> str:
    """Return "box", "round thing", "flat thing", "tall thing", "long thing" or "thing" for vertices (v, 3), +z up."""
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
    """Return the color of most of a mesh's area, "" where no color has most of it."""
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
    """Return the basic color term (n,) of CIELAB colors (n, 3)."""
    light, chroma = lab[:, 0], np.hypot(lab[:, 1], lab[:, 2])
    hue = np.degrees(np.arctan2(lab[:, 2], lab[:, 1])) % 360.0
    row = np.searchsorted([end for end, _, _ in _HUES], hue, side="right").clip(max=len(_HUES) - 1)
    bright, dark = (np.array([entry[k] for entry in _HUES])[row] for k in (1, 2))
    named = np.where((light >= _LIGHT_FROM) & ((bright != "pink") | (chroma < _VIVID)), bright, dark)
    named = np.where((named == "red") & (chroma < _DULL), "brown", named)
    plain = np.where(light < _BLACK_BELOW, "black", np.where(light >= _WHITE_FROM, "white", "gray"))
    colored = chroma >= np.clip(_COLORED_SHARE * light, _COLORED_LOW, _COLORED_HIGH)
    return np.where(colored & (light >= 0.5 * _BLACK_BELOW), named, plain)
