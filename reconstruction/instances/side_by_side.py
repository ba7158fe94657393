"""Two things that touch side by side, held for one: cut where the outline from above is pinched from both sides.

Depth smears over a gap of a centimetre or two, and a thin wall of that has no crease at which the mesh could be cut.
Seen from above the two still tell: whatever the height at which one looks, the outline has bays on both sides at one
place, and what lies on either side of it is about as long as wide. One thing has no such waist: handles and spouts are
slimmer than things, and notches of L-shaped ones are on one side. Sheets that stand, seen from above, are slim, and
their noise pinches them: so the sides of what is cut must turn towards each other at the waist, on one flank at least,
and no face runs straight on there. Where there is no waist, colors may tell (`two_colors`).
"""

from collections import deque
from dataclasses import dataclass

import cv2
import numpy as np
from scipy import ndimage

from reconstruction.instances.boxes import quantiles
from reconstruction.instances.config import InstancesConfig
from reconstruction.instances.foreign import main_colors
from reconstruction.instances.image_colors import SurfaceSamples, surface_samples, with_colors
from reconstruction.instances.merging import nearest_of
from reconstruction.instances.outlines import filled_hull
from reconstruction.instances.segmentation import Thing
from reconstruction.instances.towers import tower_parts
from reconstruction.instances.two_colors import meeting_line
from reconstruction.progress import Progress
from reconstruction.surface.mesh_graph import MeshGraph
from reconstruction.types import DepthMaps, PosedFrames, Surface

_LARGEST_M, _LARGEST_PAIR_M = 0.6, 0.8  # a tray with a carton beside it is longer than either
_CELL_M = 0.005
_LEVELS = (0.25, 0.45, 0.65, 0.8)  # of the height: skirts are below, and a top of one thing has no waist
_AXES = np.radians(np.arange(0.0, 180.0, 10.0))
_PINCH = 0.07  # depth of the shallower bay, as a share of the narrower part's width
_LONG = 0.75  # each part's length along the axis, as a share of its width
_MIN_CELLS, _MIN_SHARE = 60, 0.2  # of an outline; of it on either side
_VALLEY, _VALLEY_M = 0.2, 0.03  # how far normals turn towards the waist, of their length; this near to it
_FLAT, _COHERENT = 0.1, 0.97  # a face: they hardly turn, and have that mean length
_STEEP, _OUTWARD = 0.5, 0.3  # of |z| of a flank's normals, and of their part across the axis
_MIN_SAMPLES = 6


@dataclass(frozen=True)
class _Waist:
    depth: float  # share of the narrower part's width
    axis: np.ndarray  # float64 (2,) unit, across the waist
    at_m: float  # along the axis

    @property
    def across(self) -> np.ndarray:
        """Return the unit vector along the waist."""
        return np.array([-self.axis[1], self.axis[0]])


def cut_side_by_side(
    graph: MeshGraph,
    surface: Surface,
    things: list[Thing],
    posed: PosedFrames,
    depth: DepthMaps,
    config: InstancesConfig,
    progress: Progress,
) -> list[Thing]:
    """Cut small things with a waist, or with a bay and two colors, in two.

    Args:
        graph: the surface as a graph.
        surface: the surface in world space.
        things: what was found; theirs are the vertices.
        posed: keyframes with cameras in world space.
        depth: their depth in metres.
        config: how large a thing is at least.
        progress: told of how many were cut.

    Returns:
        The things, the smaller parts at the end; what rested on a cut one rests on the part that is nearest.
    """
    out = list(things)
    small = [
        thing
        for thing in things
        if not thing.attached and np.ptp(graph.points[thing.vertices], axis=0).max() <= _LARGEST_PAIR_M
    ]
    if not small:
        return out
    chosen = np.concatenate([thing.vertices for thing in small])
    samples = with_colors(surface_samples(graph, surface, chosen), posed, depth)
    inside = np.zeros(len(graph.points), bool)
    asked = deque(small)
    while asked:
        thing = asked.popleft()
        inside[:] = False
        inside[thing.vertices] = True
        parts = _two_things(graph, thing, samples.of(inside[samples.vertex]), config)
        if parts is None:
            continue
        thing.vertices = parts[0]
        beside = Thing(parts[1], thing.rests_on, thing.depth)
        for other in out:
            if other.rests_on is thing and nearest_of(graph, other, (thing, beside)) is beside:
                other.rests_on = beside
        out.append(beside)
        asked.extend((thing, beside))  # each may be two again
    if len(out) > len(things):
        progress.note(
            f"{len(out) - len(things)} things are cut off what they touch from the side, by their outline"
        )
    return out


def _two_things(
    graph: MeshGraph, thing: Thing, samples: SurfaceSamples, config: InstancesConfig
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the vertices of two things that touch, the larger first; None if there is but one."""
    parts = None
    if np.ptp(graph.points[thing.vertices], axis=0).max() <= _LARGEST_M:
        parts = None if thing.container else _parts(graph, thing.vertices, samples, config)
        if parts is None:
            parts = _colored_parts(graph, thing.vertices, samples, config)
    if parts is None:
        parts = tower_parts(graph, thing.vertices, samples, _ground(graph, thing), config)
    return parts


def _ground(graph: MeshGraph, thing: Thing) -> np.ndarray:
    """Return the colors (k, 3) of what carries a thing; none for what stands on the floor."""
    return np.zeros((0, 3)) if thing.rests_on is None else main_colors(graph, thing.rests_on.vertices)


def _parts(
    graph: MeshGraph, body: np.ndarray, samples: SurfaceSamples, config: InstancesConfig
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the vertices of two things that touch, the larger first; None if there is but one."""
    if not len(samples.points):
        return None
    waist = _waist(samples.points, samples.areas, config.min_object_m)
    if waist is None or waist.depth < _PINCH or not _is_valley(samples, waist):
        return None
    along = graph.points[body, :2] @ waist.axis - waist.at_m
    across = graph.points[body, :2] @ waist.across
    bottom, top = quantiles(graph.points[body, 2], graph.areas[body], (0.01, 0.99))
    high = graph.points[body, 2] > bottom + _LEVELS[0] * (top - bottom)
    parts = []
    for side in (along < 0, along >= 0):
        if graph.areas[body[side]].sum() < config.min_object_area_m2 or not (side & high).any():
            return None
        width = np.ptp(np.percentile(across[side & high], [3, 97]))
        if np.percentile(np.abs(along[side & high]), 95) < _LONG * width:
            return None
        if np.ptp(graph.points[body[side], 2]) < config.min_object_m:
            return None
        parts.append(body[side])
    first, second = sorted(parts, key=lambda part: -graph.areas[part].sum())
    return first, second


def _is_valley(samples: SurfaceSamples, waist: _Waist) -> bool:
    """Tell whether the sides of two things turn towards each other at a waist, on one of its flanks at least."""
    along = samples.points[:, :2] @ waist.axis - waist.at_m
    bottom, top = quantiles(samples.points[:, 2], samples.areas, (0.01, 0.99))
    near = (np.abs(along) < _VALLEY_M) & (np.abs(samples.normals[:, 2]) < _STEEP)
    near &= samples.points[:, 2] > bottom + _LEVELS[0] * (top - bottom)
    towards, outwards = (samples.normals[:, :2] @ axis for axis in (waist.axis, waist.across))
    found = False
    for flank in (near & (outwards > _OUTWARD), near & (outwards < -_OUTWARD)):
        sides = [flank & (along < 0), flank & (along >= 0)]
        if min(side.sum() for side in sides) < _MIN_SAMPLES:
            continue
        first, second = (np.average(towards[side], weights=samples.areas[side]) for side in sides)
        if abs(first - second) < _FLAT and _is_flat(samples.of(flank)):
            return False  # one face that runs on
        found |= first - second > _VALLEY
    return found


def _is_flat(samples: SurfaceSamples) -> bool:
    normals = samples.normals / np.linalg.norm(samples.normals, axis=1, keepdims=True)
    return bool(np.linalg.norm(np.average(normals, axis=0, weights=samples.areas)) > _COHERENT)


def _colored_parts(
    graph: MeshGraph, body: np.ndarray, samples: SurfaceSamples, config: InstancesConfig
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the vertices of two things of different colors that touch, the larger first; None if there is but one."""
    line = meeting_line(graph.points[body], graph.areas[body], samples)
    if line is None:
        return None
    first = graph.points[body, :2] @ line[0] < line[1]
    parts = sorted((body[first], body[~first]), key=lambda part: -graph.areas[part].sum())
    for part in parts:
        extents = np.ptp(graph.points[part], axis=0)
        if graph.areas[part].sum() < config.min_object_area_m2 or extents.min() < config.min_object_m:
            return None
    return parts[0], parts[1]


def _waist(points: np.ndarray, areas: np.ndarray, slim_m: float) -> _Waist | None:
    """Return the deepest waist that the outlines of points (n, 3) above several heights share."""
    low = points[:, :2].min(axis=0) - 4 * _CELL_M
    bottom, top = quantiles(points[:, 2], areas, (0.01, 0.99))
    cells = np.floor((points[:, :2] - low) / _CELL_M).astype(int)
    outlines = []
    for level in _LEVELS:
        mask = np.zeros(cells.max(axis=0) + 5, bool)
        mask[tuple(cells[points[:, 2] > bottom + level * (top - bottom)].T)] = True
        mask = ndimage.binary_fill_holes(ndimage.binary_closing(mask, np.ones((3, 3))))
        mask = ndimage.binary_opening(mask, _disc(slim_m))
        if mask.sum() < _MIN_CELLS:
            return None
        outlines.append((mask, filled_hull(mask)))
    best: _Waist | None = None
    for angle in _AXES:
        axis = np.array([np.cos(angle), np.sin(angle)])
        depth = np.min([_bays(mask, hull, axis, slim_m) for mask, hull in outlines], axis=0)
        strip = int(np.argmax(depth))
        if depth[strip] > (0.0 if best is None else best.depth):
            reach = len(depth) // 2
            best = _Waist(float(depth[strip]), axis, float(low @ axis) + (strip - reach + 0.5) * _CELL_M)
    return best


def _bays(mask: np.ndarray, hull: np.ndarray, axis: np.ndarray, slim_m: float) -> np.ndarray:
    """Return for each strip across an axis how deep the shallower of the bays at its ends is, 0 where it is no waist.

    Strips are as wide as a cell, the middle one begins at the first cell of the grid.
    """
    reach = int(np.ceil(np.hypot(*mask.shape))) + 1
    ends = [_ends(cells, axis, reach) for cells in (mask, hull)]
    (low, high), (outer_low, outer_high) = ends
    there = high >= low
    width = np.subtract(high, low, out=np.full(2 * reach, -1.0), where=there) + 1.0
    bay = np.zeros(2 * reach)
    bay[there] = np.minimum(outer_high[there] - high[there], low[there] - outer_low[there])
    lobe = np.minimum(np.maximum.accumulate(width), np.maximum.accumulate(width[::-1])[::-1])
    share = np.cumsum(width) / width.sum()
    fits = there & (lobe * _CELL_M > slim_m) & (np.minimum(share, 1.0 - share) > _MIN_SHARE)
    depth = np.where(fits, bay / np.maximum(lobe, 1.0), 0.0)
    return ndimage.maximum_filter1d(depth, 3)


def _ends(cells: np.ndarray, axis: np.ndarray, reach: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the least and the largest place across an axis of the cells in each strip, in cells."""
    at = np.argwhere(cells) + 0.5
    strip = np.floor(at @ axis).astype(int) + reach
    across = at @ np.array([-axis[1], axis[0]])
    low, high = np.full(2 * reach, np.inf), np.full(2 * reach, -np.inf)
    np.minimum.at(low, strip, across)
    np.maximum.at(high, strip, across)
    return low, high


def _disc(diameter_m: float) -> np.ndarray:
    size = 2 * round(0.5 * diameter_m / _CELL_M) + 1
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)) > 0
