"""Outlines and a scene in, recall, precision and relations out: one-to-one matching by IoU over the labelled frames."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from reconstruction.measure.matching import match
from reconstruction.measure.outline_labels import BASE_NAMES, OutlineLabels
from reconstruction.measure.outline_views import OutlineView, draw_views
from reconstruction.measure.scene import PlacedMesh
from registry import SceneBundle
from registry.errors import UsageError

if TYPE_CHECKING:
    from reconstruction.poses.lens import Lens

IOU_BOUNDS = (0.25, 0.5)
_LEAST_SHARE = 0.0008  # of a frame that an object covers to be counted for precision


@dataclass(frozen=True)
class OutlineScores:
    """What `score_outlines` returns."""

    metrics: dict[str, float | None]  # names of CONTRACT section 5, the IoU in percent at their end
    things: list[dict[str, Any]]  # one record a thing that is asked for
    extra: list[dict[str, Any]]  # objects that count for precision and match no thing
    views: tuple[OutlineView, ...]  # frames that were measured, in the labels' order
    without_camera: tuple[int, ...]  # labelled frames of which the scene has no camera

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
        bundle: the scene; its cameras and graph are read.
        meshes: all of its meshes, base included, in its world (`placed_meshes`).
        labels: outlines on frames as filmed.
        lens: from the film to the straightened frames of the bundle's cameras; None: the film has no distortion.

    Raises:
        UsageError: a labelled frame does not exist or has another shape than the film; no labelled frame has a camera;
            nothing that is asked for is outlined.
    """
    views, without = draw_views(bundle, meshes, labels, lens)
    names = list(labels.things)
    objects = [mesh for mesh in meshes if not mesh.base]
    counts = np.array([_shared_pixels(view, names, [mesh.id for mesh in objects]) for view in views])
    ignored = np.array([name in labels.ignore for name in names], bool)
    asked = np.flatnonzero(~ignored & (counts[:, : len(names)].sum(axis=(0, 2)) > 0))
    if not len(asked):
        raise UsageError(
            f"labels {labels.path}: nothing that is asked for is outlined in a frame with a camera"
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
    """Count pixels int64 (len(names) + 2, len(ids) + 1) by what is outlined (`label_map`) and which object shows.

    The last column is everything that is no object.
    """
    drawn = view.frame.label_map(names)
    column_of = np.full(max([0, *ids]) + 1, len(ids))
    column_of[list(ids)] = np.arange(len(ids))
    width = len(ids) + 1
    flat = np.bincount((drawn * width + column_of[view.shown]).ravel(), minlength=(len(names) + 2) * width)
    return flat.reshape(-1, width)


def _iou(counts: np.ndarray) -> np.ndarray:
    """Return the IoU (things, objects) over all frames of counts (frames, things + 2, objects + 1)."""
    shared = counts.sum(axis=0)
    both = shared[:-2, :-1]
    union = shared[:-2].sum(axis=1)[:, None] + shared[:, :-1].sum(axis=0)[None] - both
    return both / np.maximum(union, 1)


def _counted(counts: np.ndarray, ignored: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Tell which objects count for precision: large enough in some frame, and mostly outside of what is ignored.

    Args:
        counts: (frames, things + 2, objects + 1) as `_shared_pixels` has them.
        ignored: (things,) whether a thing is not asked for.
        pixels: (frames,) of the whole frame.
    """
    rows = np.array([*ignored, True, False])
    judged, not_judged = counts[:, ~rows, :-1].sum(axis=1), counts[:, rows, :-1].sum(axis=1)
    large = (judged > _LEAST_SHARE * pixels[:, None]).any(axis=0)
    return large & (not_judged.sum(axis=0) < judged.sum(axis=0))


def _relations(
    bundle: SceneBundle, labels: OutlineLabels, match_of: dict[str, PlacedMesh]
) -> dict[str, bool]:
    """Tell by name whether a matched thing has the right parent; things whose parent is not matched are left out."""
    parent_of = {edge["child"]: edge["parent"] for edge in bundle.scene["graph"]["edges"]}
    base = {item["id"]: item["label"] for item in bundle.scene["base"]}
    out = {}
    for name, found in match_of.items():
        parent = labels.things[name]
        if parent in match_of:
            out[name] = parent_of.get(found.id) == match_of[parent].id
        elif parent in BASE_NAMES and parent not in labels.things:
            out[name] = base.get(parent_of.get(found.id)) == parent
    return out
