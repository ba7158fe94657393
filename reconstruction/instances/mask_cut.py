"""Segmentation by 2D masks: lift them onto the surface, classify clusters as base or objects, and clean these up."""

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]

from reconstruction.core.mesh_graph import MeshGraph, pieces
from reconstruction.core.progress import Progress
from reconstruction.core.types import DepthMaps, PosedFrames, Surface
from reconstruction.instances.colors import LIGHTNESS_WEIGHT
from reconstruction.instances.config import InstancesConfig
from reconstruction.instances.contacts import carriers
from reconstruction.instances.cut import Cut, Shell, Thing
from reconstruction.instances.lifting import Lifted, lift_masks
from reconstruction.instances.masks.base import FrameMasks

_SURE_SHARE = 0.65  # least agreement of the frames at a vertex; flying pixels and floaters are below it
_BRIDGE_M = 0.03  # pieces of an object within this gap are connected
# Pieces that are not connected to the largest one: below this share of its area they need
_FRAGMENT_SHARE = 0.1
_FRAGMENT_FRAMES, _FRAGMENT_AGREED = 2.0, 0.8  # so many frames per vertex, and so much agreement;
_CRUMB_SHARE = 0.005  # below this share they are always removed.
_BLEED_RISE_M, _BLEED_REACH_M = 0.01, 0.03  # bleeding surface: above an object's foot, and around it;
_BARE_SHARE, _BARE_REACH_M = 0.08, 0.15  # the reach for supports with less area than this share above it
_LEAST_AREA_SHARE = 0.5  # of `min_object_area_m2`: masks confirm smaller objects than shape alone does
_FLAT_SHARE = 0.5  # a cluster with more of its area on base planes is base, or lies flat on it
_SEGMENT_SHARE = 0.25  # a cluster with more of a plane's area is part of the plane
# A flat object differs from the plane's color by more than _OTHER_COLOR in this share of its vertices, a shadow less.
_COLORED_SHARE, _OTHER_COLOR = 0.08, 8.0
_ON_WALL_M = 0.06  # objects nearer to a wall touch it
_MIN_ATTACHED_M = 0.15  # least height of an attached object above the floor


def cut_by_masks(
    shell: Shell, surface: Surface, posed: PosedFrames, depth: DepthMaps, masks: FrameMasks, config: InstancesConfig,
    progress: Progress,
) -> Cut:  # fmt: skip
    """Segment the surface into base and objects by 2D masks; `labeled` of the result is at depth resolution."""
    graph = shell.graph
    lifted = lift_masks(graph, surface, posed, depth, masks, progress)
    label = np.where(shell.behind | (lifted.share < _SURE_SHARE), 0, lifted.cluster)
    base_id = _base_clusters(shell, label, lifted.count)
    base = base_id > 0
    frames = np.maximum((lifted.views.seen > 0).sum(axis=0), 1)
    label = _without_fragments(graph, np.where(base[label], 0, label), lifted.count, frames, lifted.share)
    label = _without_small(graph, label, lifted.count, config)
    kept = np.unique(label[label > 0])
    things = [Thing(np.flatnonzero(label == c)) for c in kept]
    names = base_id.copy()
    names[kept] = len(shell.base) + 1 + np.arange(len(kept))
    _note_counts(lifted, base, len(things), progress)
    owner = np.where(label > 0, 0, shell.owner).astype(np.int32)
    for thing, carrier in zip(things, carriers(graph, [t.vertices for t in things])):
        thing.rests_on = things[carrier] if carrier >= 0 else None
    for thing in things:
        _drop_bleeding(graph, thing, [t for t in things if t.rests_on is thing])
    mark_attached(shell, things)
    small = masks.resized(depth.camera.width, depth.camera.height)
    return Cut(things, owner, labeled=_labeled(small, lifted, names))


def _labeled(masks: FrameMasks, lifted: Lifted, names: np.ndarray) -> FrameMasks:
    """Return the masks with ids `names` (count + 1,) of their clusters, 0 where the cluster has none."""
    ids = np.zeros_like(masks.ids)
    views = lifted.views
    for row, own in enumerate(masks.ids):
        table = np.zeros(int(own.max()) + 1, np.uint16)
        numbers = np.flatnonzero(views.mask_frame == row)
        there = numbers[views.mask_id[numbers] < len(table)]
        table[views.mask_id[there]] = names[lifted.mask_cluster[there]]
        ids[row] = table[own]
    return replace(masks, ids=ids)


def _note_counts(lifted: Lifted, base: np.ndarray, things: int, progress: Progress) -> None:
    split = int((lifted.mask_cluster[1:] == 0).sum())
    progress.note(
        f"{lifted.views.mask_count} masks of {len(lifted.views.seen)} frames agree on {things} objects and "
        f"{int(base.sum())} parts of floor and walls; {split} masks that other frames split were ignored"
    )


def _base_clusters(shell: Shell, label: np.ndarray, count: int) -> np.ndarray:
    """Return the base entity int32 (count + 1,) that each cluster is part of, 0 for objects."""
    graph, planes = shell.graph, len(shell.base) + 1
    table = np.zeros((count + 1, planes))
    np.add.at(table, (label, shell.owner), graph.areas)
    total, on_base = table.sum(axis=1), table[:, 1:].sum(axis=1)
    flat = on_base > _FLAT_SHARE * np.maximum(total, 1e-12)
    base = np.zeros(count + 1, bool)
    for number in range(1, planes):
        area = np.where(flat, table[:, number], 0.0)
        area[0] = 0.0
        if area.max() <= 0:
            continue
        main = int(np.argmax(area))
        base[main] = True
        ground = _color(graph, (label == main) & (shell.owner == number))
        for other in np.flatnonzero((area > 0.5 * on_base) & (area > 0)):
            large = area[other] > _SEGMENT_SHARE * table[:, number].sum()
            colors = graph.lab[label == other] * LIGHTNESS_WEIGHT
            differs = np.linalg.norm(colors - ground, axis=1) > _OTHER_COLOR
            base[other] |= bool(large or differs.mean() < _COLORED_SHARE)
    return np.where(base, 1 + np.argmax(table[:, 1:], axis=1), 0).astype(np.int32)


def _color(graph: MeshGraph, chosen: np.ndarray) -> np.ndarray:
    return np.median(graph.lab[chosen] * LIGHTNESS_WEIGHT, axis=0)


def _without_fragments(
    graph: MeshGraph, label: np.ndarray, count: int, frames: np.ndarray, agreed: np.ndarray
) -> np.ndarray:
    """Return the labels without small disconnected pieces of clusters, unless several frames agree on them.

    Args:
        graph: the surface.
        label: int (v,) cluster of each vertex.
        count: number of clusters.
        frames: int (v,) number of frames that see each vertex in a mask.
        agreed: float (v,) share of them that agree.
    """
    out = label.copy()
    for number in range(1, count + 1):
        parts = pieces(graph, np.flatnonzero(label == number), _BRIDGE_M)
        if len(parts) < 2:
            continue
        main = graph.areas[parts[0]].sum()
        for part in parts[1:]:
            share = graph.areas[part].sum() / main
            enough = min(_FRAGMENT_FRAMES, 0.5 * frames[parts[0]].mean())
            weak = frames[part].mean() < enough or agreed[part].mean() < _FRAGMENT_AGREED
            if share < _CRUMB_SHARE or (share < _FRAGMENT_SHARE and weak):
                out[part] = 0
    return out


def _without_small(graph: MeshGraph, label: np.ndarray, count: int, config: InstancesConfig) -> np.ndarray:
    """Return the labels without clusters below the least size of objects."""
    vertices = np.bincount(label, minlength=count + 1)
    area = np.bincount(label, weights=graph.areas, minlength=count + 1)
    small = (vertices < config.min_object_vertices) | (area < _LEAST_AREA_SHARE * config.min_object_area_m2)
    return np.where(small[label], 0, label)


def _drop_bleeding(graph: MeshGraph, carrier: Thing, carried: list[Thing]) -> None:
    """Remove from a support, in place, the surface that rises beside the objects on it.

    Depth maps bleed over the occlusion boundaries of these objects. In the masks the bleeding surface projects onto the
    support, so that votes do not remove it.
    """
    for thing in carried:
        own = graph.points[thing.vertices]
        points = graph.points[carrier.vertices]
        bottom = float(np.percentile(own[:, 2], 2))
        near = points[:, 2] > bottom + _BLEED_RISE_M
        areas = graph.areas[carrier.vertices]
        # A table has hardly any surface above its top; a tray has rims, a shelf has more boards.
        bare = areas[near].sum() < _BARE_SHARE * areas.sum()
        reach = _BARE_REACH_M if bare else _BLEED_REACH_M
        near[near] = cKDTree(own).query(points[near], distance_upper_bound=reach)[0] < reach
        if near.mean() < 0.5:
            carrier.vertices = carrier.vertices[~near]


def mark_attached(shell: Shell, things: list[Thing]) -> None:
    """Set `attached` for objects without support that touch a wall and are off the floor."""
    graph = shell.graph
    for thing in things:
        points = graph.points[thing.vertices]
        if thing.rests_on is not None or points[:, 2].min() < _MIN_ATTACHED_M:
            continue
        for plane in shell.planes:
            if plane.label == "wall" and np.percentile(plane.distance(points), 5) < _ON_WALL_M:
                thing.attached = True
