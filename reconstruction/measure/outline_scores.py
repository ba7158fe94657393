"""Score a scene against outlines: recall, precision and relations after one-to-one matching by mask IoU."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from reconstruction.measure.matching import IOU_BOUNDS, match
from reconstruction.measure.outline_labels import BASE_NAMES, OutlineLabels
from reconstruction.measure.outline_views import OutlineView, draw_views
from reconstruction.measure.scene import PlacedMesh
from registry import SceneBundle
from registry.errors import UsageError

if TYPE_CHECKING:
    from reconstruction.poses.lens import Lens

_LEAST_SHARE = 0.0008  # CONTRACT section 5: of a frame, that an object must cover to count for precision


@dataclass(frozen=True)
class OutlineScores:
    """The result of `score_outlines`."""

    metrics: dict[str, float | None]  # names of CONTRACT section 5, with the IoU bound in percent as suffix
    things: list[dict[str, Any]]  # one record per evaluated outlined object
    extra: list[dict[str, Any]]  # objects that count for precision and match no outline
    views: tuple[OutlineView, ...]  # evaluated frames, in the labels' order
    without_camera: tuple[int, ...]  # labelled frames without a camera in the scene

    def to_json(self) -> dict[str, Any]:
        """Return the records as JSON values."""
        return {
            "frames": [view.frame.index for view in self.views],
            "frames_without_camera": list(self.without_camera),
            "things": self.things,
            "extra": self.extra,
        }


def score_outlines(
    bundle: SceneBundle, meshes: Sequence[PlacedMesh], labels: OutlineLabels, lens: "Lens | None" = None
) -> OutlineScores:
    """Compute `outline_recall`, `outline_precision` and `outline_edges` of a scene (CONTRACT section 5).

    Args:
        bundle: the scene, for its cameras and graph.
        meshes: all of its meshes, base included, in its world (`placed_meshes`).
        labels: outlines on frames of the video.
        lens: distortion between the video and the bundle's undistorted cameras; None: no distortion.

    Raises:
        UsageError: a labelled frame does not exist or has another aspect ratio than the video; no labelled frame has a
            camera; no evaluated object is outlined.
    """
    views, without = draw_views(bundle, meshes, labels, lens)
    names = list(labels.things)
    objects = [mesh for mesh in meshes if not mesh.base]
    counts = np.array([_shared_pixels(view, names, [mesh.id for mesh in objects]) for view in views])
    ignored = np.array([name in labels.ignore for name in names], bool)
    asked = np.flatnonzero(~ignored & (counts[:, : len(names)].sum(axis=(0, 2)) > 0))
    if not len(asked):
        raise UsageError(
            f"labels {labels.path}: no object that is evaluated is outlined in a frame with a camera"
        )
    iou = _iou(counts)[asked]
    pairs = {bound: dict(match(iou, bound)) for bound in IOU_BOUNDS}
    counted = _counted(counts, ignored, np.array([view.shown.size for view in views]))
    metrics: dict[str, float | None] = {}
    for bound, found in pairs.items():
        right = sum(counted[column] for column in found.values())
        metrics[f"outline_recall_{100 * bound:.0f}"] = len(found) / len(asked)
        metrics[f"outline_precision_{100 * bound:.0f}"] = float(right / max(counted.sum(), 1))
    found = pairs[IOU_BOUNDS[0]]
    match_of = {names[asked[row]]: objects[column] for row, column in found.items()}
    relations = _relations(bundle, labels, match_of)
    metrics["outline_edges"] = sum(relations.values()) / len(relations) if relations else None
    metrics.update(outline_things=len(asked), outline_objects=int(counted.sum()), outline_frames=len(views))
    pixels = counts.sum(axis=(0, 2))
    things = [
        {
            "name": names[thing],
            "kind": labels.kinds.get(names[thing]),
            "parent": labels.things[names[thing]],
            "pixels": int(pixels[thing]),
            "match": objects[found[row]].id if row in found else None,
            "found_label": objects[found[row]].label if row in found else None,
            "iou": float(iou[row, found[row]] if row in found else iou[row].max(initial=0.0)),
            **{f"found_{100 * bound:.0f}": row in at for bound, at in pairs.items()},
            "parent_right": relations.get(names[thing]),
        }
        for row, thing in enumerate(asked)
    ]
    taken = set(found.values())
    extra = [{"id": m.id, "label": m.label} for c, m in enumerate(objects) if counted[c] and c not in taken]
    return OutlineScores(metrics, things, extra, views, without)


def _shared_pixels(view: OutlineView, names: Sequence[str], ids: Sequence[int]) -> np.ndarray:
    """Count pixels by label (`label_map`) and rendered object: int64 (len(names) + 2, len(ids) + 1).

    The last column counts base and background.
    """
    drawn = view.frame.label_map(names)
    column_of = np.full(max([0, *ids]) + 1, len(ids))
    column_of[list(ids)] = np.arange(len(ids))
    width = len(ids) + 1
    flat = np.bincount((drawn * width + column_of[view.shown]).ravel(), minlength=(len(names) + 2) * width)
    return flat.reshape(-1, width)


def _iou(counts: np.ndarray) -> np.ndarray:
    """Compute the IoU (things, objects), summed over frames, from counts (frames, things + 2, objects + 1)."""
    shared = counts.sum(axis=0)
    both = shared[:-2, :-1]
    union = shared[:-2].sum(axis=1)[:, None] + shared[:, :-1].sum(axis=0)[None] - both
    return both / np.maximum(union, 1)


def _counted(counts: np.ndarray, ignored: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Return which objects count for precision: large enough in a frame, and mostly outside of ignored areas.

    Args:
        counts: (frames, things + 2, objects + 1) of `_shared_pixels`.
        ignored: bool (things,), outlined objects that are not evaluated.
        pixels: (frames,) image size in pixels.
    """
    rows = np.array([*ignored, True, False])
    judged, not_judged = counts[:, ~rows, :-1].sum(axis=1), counts[:, rows, :-1].sum(axis=1)
    large = (judged > _LEAST_SHARE * pixels[:, None]).any(axis=0)
    return large & (not_judged.sum(axis=0) < judged.sum(axis=0))


def _relations(
    bundle: SceneBundle, labels: OutlineLabels, match_of: dict[str, PlacedMesh]
) -> dict[str, bool]:
    """Return by name whether a matched object has the right parent; without those whose parent is unmatched."""
    parent_of = {edge["child"]: edge["parent"] for edge in bundle.scene["graph"]["edges"]}
    base = {item["id"]: item["label"] for item in bundle.scene["base"]}
    out = {}
    for name, found in match_of.items():
        parent, estimated = labels.things[name], parent_of.get(found.id)
        if parent in match_of:
            out[name] = estimated == match_of[parent].id
        elif parent in BASE_NAMES and parent not in labels.things:
            out[name] = base.get(estimated) == parent
    return out
