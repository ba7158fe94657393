"""The cut by masks: clusters of masks become base or things, cleaned of what clings to them."""

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from reconstruction.core.mesh_graph import MeshGraph, pieces
from reconstruction.core.progress import Progress
from reconstruction.core.types import DepthMaps, PosedFrames, Surface
from reconstruction.instances.colors import LIGHTNESS_WEIGHT
from reconstruction.instances.config import InstancesConfig
from reconstruction.instances.contacts import carriers
from reconstruction.instances.cut import Cut, Shell, Thing
from reconstruction.instances.lifting import Lifted, lift_masks
from reconstruction.instances.masks.base import FrameMasks

# Of the frames that see a vertex, so many must see one thing there: skirts and floaters are seen against this or that.
_SURE_SHARE = 0.65
_BRIDGE_M = 0.03
# Pieces apart from the largest one of a thing: below this share of it they need several frames that agree,
_FRAGMENT_SHARE, _FRAGMENT_FRAMES, _FRAGMENT_AGREED = 0.1, 2.0, 0.8
_CRUMB_SHARE = 0.005  # and below this nothing helps.
_SKIRT_RISE_M, _SKIRT_REACH_M = 0.01, 0.03  # above the foot of a thing, and around it
_BARE_SHARE, _BARE_REACH_M = 0.08, 0.15  # what has less of its surface above the foot is bare around it
_LEAST_AREA_SHARE = 0.5  # masks vouch for smaller things than shape alone does
_FLAT_SHARE = 0.5  # of a cluster's surface on floor or walls: it is base, or lies flat on it
_SEGMENT_SHARE = 0.25  # of a plane's surface: a part of the wall, no picture
# A thing that lies flat on a plane shows in this share of it another color than the plane's; a shadow does not.
_COLORED_SHARE, _OTHER_COLOR = 0.08, 8.0
_ON_WALL_M = 0.06
_MIN_ATTACHED_M = 0.15


def cut_by_masks(
    shell: Shell,
    surface: Surface,
    posed: PosedFrames,
    depth: DepthMaps,
    masks: FrameMasks,
    config: InstancesConfig,
    progress: Progress,
) -> Cut:
    """Lift masks onto the surface and divide it into base and things."""
    graph = shell.graph
    lifted = lift_masks(graph, surface, posed, depth, masks, progress)
    label = np.where(shell.behind | (lifted.share < _SURE_SHARE), 0, lifted.cluster)
    base_id = _base_clusters(shell, label, lifted.count)
    base = base_id > 0
    frames = np.maximum((lifted.views.seen > 0).sum(axis=0), 1)
    label = _without_fragments(graph, np.where(base[label], 0, label), lifted.count, frames, lifted.share)
    label = _without_crumbs(graph, label, lifted.count, config)
    kept = np.unique(label[label > 0])
    things = [Thing(np.flatnonzero(label == c)) for c in kept]
    names = base_id.copy()
    names[kept] = len(shell.base) + 1 + np.arange(len(kept))
    _tell(lifted, base, len(things), progress)
    owner = np.where(label > 0, 0, shell.owner).astype(np.int32)
    for thing, carrier in zip(things, carriers(graph, [t.vertices for t in things])):
        thing.rests_on = things[carrier] if carrier >= 0 else None
    for thing in things:
        _drop_skirts(graph, thing, [t for t in things if t.rests_on is thing])
    mark_attached(shell, things)
    return Cut(things, owner, _named(masks.resized(depth.camera.width, depth.camera.height), lifted, names))


def _named(masks: FrameMasks, lifted: Lifted, names: np.ndarray) -> FrameMasks:
    """Return the masks with the names (count + 1,) of their clusters for ids, 0 where the cluster has none."""
    ids = np.zeros_like(masks.ids)
    views = lifted.views
    for row, own in enumerate(masks.ids):
        table = np.zeros(int(own.max()) + 1, np.uint16)
        numbers = np.flatnonzero(views.mask_frame == row)
        there = numbers[views.mask_id[numbers] < len(table)]
        table[views.mask_id[there]] = names[lifted.mask_cluster[there]]
        ids[row] = table[own]
    return replace(masks, ids=ids)


def _tell(lifted: Lifted, base: np.ndarray, things: int, progress: Progress) -> None:
    split = int((lifted.mask_cluster[1:] == 0).sum())
    progress.note(
        f"{lifted.views.mask_count} masks of {len(lifted.views.seen)} frames agree on {things} things and "
        f"{int(base.sum())} parts of floor and walls; {split} masks that other frames split had no say"
    )


def _base_clusters(shell: Shell, label: np.ndarray, count: int) -> np.ndarray:
    """Return the base entity, int32 (count + 1,), that a cluster is part of; 0 for those that are things."""
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
    """Take small pieces apart from the rest of their thing away from it, unless several frames saw them.

    Args:
        graph: the surface.
        label: int (v,) cluster of each vertex.
        count: of clusters.
        frames: int (v,) how many frames see each vertex in a mask.
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


def _without_crumbs(graph: MeshGraph, label: np.ndarray, count: int, config: InstancesConfig) -> np.ndarray:
    """Take clusters with too little surface to be things away."""
    vertices = np.bincount(label, minlength=count + 1)
    area = np.bincount(label, weights=graph.areas, minlength=count + 1)
    crumb = (vertices < config.min_object_vertices) | (area < _LEAST_AREA_SHARE * config.min_object_area_m2)
    return np.where(crumb[label], 0, label)


def _drop_skirts(graph: MeshGraph, carrier: Thing, carried: list[Thing]) -> None:
    """Take from a carrier what rises right beside the things on it, in place: depth is fat at their outlines.

    Frames see such skirts against the carrier, so that votes alone leave them to it.
    """
    for thing in carried:
        own = graph.points[thing.vertices]
        points = graph.points[carrier.vertices]
        bottom = float(np.percentile(own[:, 2], 2))
        near = points[:, 2] > bottom + _SKIRT_RISE_M
        areas = graph.areas[carrier.vertices]
        # A table has next to nothing above its top; a tray has rims, a shelf has more boards.
        bare = areas[near].sum() < _BARE_SHARE * areas.sum()
        reach = _BARE_REACH_M if bare else _SKIRT_REACH_M
        near[near] = cKDTree(own).query(points[near], distance_upper_bound=reach)[0] < reach
        if near.mean() < 0.5:
            carrier.vertices = carrier.vertices[~near]


def mark_attached(shell: Shell, things: list[Thing]) -> None:
    """Mark things that touch a wall and have nothing below them."""
    graph = shell.graph
    for thing in things:
        points = graph.points[thing.vertices]
        if thing.rests_on is not None or points[:, 2].min() < _MIN_ATTACHED_M:
            continue
        for plane in shell.planes:
            if plane.label == "wall" and np.percentile(plane.distance(points), 5) < _ON_WALL_M:
                thing.attached = True
