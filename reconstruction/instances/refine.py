"""A cut seen anew: its things are drawn into keyframes, borders moved to image edges, and voted back.

Depth is fat at outlines, so that a thing drags a skirt of its carrier's or its background's surface along. Drawn into
a frame that looks from elsewhere, the skirt lies where the image shows something else; the borders of the id maps snap
to the edges of color there, and most frames then put the skirt where it belongs.
"""

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from reconstruction.instances.config import InstancesConfig
from reconstruction.instances.cut import Cut, Shell
from reconstruction.instances.id_maps import draw_ids, snapped_ids
from reconstruction.instances.lifting import vote
from reconstruction.instances.lifting_views import view_masks
from reconstruction.instances.masks.base import FrameMasks
from reconstruction.progress import Progress
from reconstruction.surface.mesh_graph import MeshGraph, pieces
from reconstruction.types import DepthMaps, PosedFrames, Surface

_MAX_FRAMES = 36
_MIN_FRAMES = 2  # that see a vertex
_SURE_SHARE = 0.6  # of them must put it elsewhere
_LEAST_KEPT = 0.5  # of a thing's area: votes that take more are not trusted
_LEAST_LOST = 0.03  # and what is less is the rim that every cut has, no skirt
_SCRAP_SHARE, _SCRAP_GAP_M = 0.05, 0.25  # of a thing's area; away from the rest of it
_LEAST_DRAWN = 0.75  # of a thing's pixels: a frame whose snapping takes more draws it too small to tell


def refine_by_views(
    shell: Shell, cut: Cut, surface: Surface, posed: PosedFrames, depth: DepthMaps, config: InstancesConfig,
    progress: Progress,
) -> Cut:  # fmt: skip
    """Give the vertices of things that most keyframes see on something else to that.

    Args:
        shell: the surface and its base.
        cut: the things to refine.
        surface: what was cut.
        posed: keyframes in world space.
        depth: their depth in metres.
        config: how far borders may snap.
        progress: told of every frame.

    Returns:
        The same things, none without more than half of its area, and none that hangs with scraps of surface far from
        the rest of it; vertices that base entities win have their ids.
    """
    if not cut.things or config.snap_radius_px <= 0:
        return cut
    first = len(shell.base) + 1
    label = cut.owner.astype(np.int32)
    for number, thing in enumerate(cut.things, start=first):
        label[thing.vertices] = number
    masks = _drawn(label, surface, posed, depth, config)
    views = view_masks(shell.graph, surface, posed, depth, masks, progress)
    winner, votes, seen = vote(np.ascontiguousarray(views.seen.T), views.mask_id)
    sure = (seen >= _MIN_FRAMES) & (votes >= _SURE_SHARE * seen) & (winner > 0)
    refined = np.where(sure & (label >= first), winner, label).astype(np.int32)
    areas = shell.graph.areas
    for number, thing in enumerate(cut.things, start=first):
        kept = areas[thing.vertices[refined[thing.vertices] == number]].sum() / areas[thing.vertices].sum()
        if not _LEAST_KEPT <= kept < 1.0 - _LEAST_LOST:
            refined[thing.vertices] = number
    for number, thing in enumerate(cut.things, start=first):
        if thing.attached:  # legs and boards of furniture may be far from the rest of what was fused
            refined[_far_scraps(shell.graph, np.flatnonzero(refined == number), config.bridge_gap_m)] = 0
    things = [
        replace(thing, vertices=np.flatnonzero(refined == number))
        for number, thing in enumerate(cut.things, start=first)
    ]
    renewed = {id(old): new for old, new in zip(cut.things, things)}
    for thing in things:
        thing.rests_on = renewed.get(id(thing.rests_on))
    return Cut(things, np.where(refined < first, refined, 0).astype(np.int32))


def _far_scraps(graph: MeshGraph, vertices: np.ndarray, bridge_m: float) -> np.ndarray:
    """Return the vertices of small pieces so far from the rest of a thing that they only have its id by mistake."""
    groups = pieces(graph, vertices, bridge_m)
    least = _SCRAP_SHARE * graph.areas[vertices].sum()
    small = [group for group in groups if graph.areas[group].sum() < least]
    if not small or len(small) == len(groups):
        return vertices[:0]
    rest = cKDTree(graph.points[np.concatenate([g for g in groups if graph.areas[g].sum() >= least])])
    far = [group for group in small if rest.query(graph.points[group])[0].min() > _SCRAP_GAP_M]
    return np.concatenate(far) if far else vertices[:0]


def _drawn(
    label: np.ndarray, surface: Surface, posed: PosedFrames, depth: DepthMaps, config: InstancesConfig
) -> FrameMasks:
    """Return the labeled surface as masks of keyframes spread over the film."""
    count = len(posed.images)
    rows = np.unique(np.linspace(0, count - 1, min(count, _MAX_FRAMES)).round().astype(int))
    ids = np.zeros((len(rows), depth.camera.height, depth.camera.width), np.uint16)
    for k, row in enumerate(rows):
        drawn = draw_ids(surface, label, posed, depth, row)
        ids[k] = _without_eaten(drawn, snapped_ids(drawn, posed, depth, row, config))
    return FrameMasks(depth.camera, posed.indices[rows], posed.world_from_camera[rows], ids)


def _without_eaten(drawn: np.ndarray, snapped: np.ndarray) -> np.ndarray:
    """Return snapped ids (h, w), 0 around what is so small in this frame that snapping took much of it."""
    count = int(max(drawn.max(), snapped.max())) + 1
    whole = np.bincount(drawn.ravel(), minlength=count)
    kept = np.bincount(drawn[drawn == snapped], minlength=count)
    eaten = (kept < _LEAST_DRAWN * whole) & (whole > 0)
    eaten[0] = False
    return np.where(eaten[drawn] | eaten[snapped], 0, snapped).astype(np.uint16)
