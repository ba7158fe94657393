"""Flat things that were left in what they lie on: trays, plates and boards of the support's color.

Their level parts are too low to stand out from a support and of its color, so that rules for candidates take them for
the support. Seen from above they tell all the same: an area of level surface a few millimetres higher than the rest,
compact, of one height, and around it the image shows another color or the line of a rim.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from reconstruction.instances.colors import LIGHTNESS_WEIGHT
from reconstruction.instances.config import InstancesConfig
from reconstruction.instances.image_colors import SurfaceSamples, surface_samples, with_colors
from reconstruction.instances.merging import join
from reconstruction.instances.outlines import filled_hull
from reconstruction.instances.segmentation import Thing
from reconstruction.instances.supports import SupportRegion, find_supports
from reconstruction.progress import Progress
from reconstruction.surface.mesh_graph import MeshGraph
from reconstruction.types import DepthMaps, PosedFrames, Surface

_CELL_M = 0.01
_MIN_SUPPORT_M2 = 0.05
_MIN_FLAT_M2 = 0.008
_LEAST_RISE_M, _MOST_RISE_M = 0.004, 0.035  # of the level part above its support
_NOISE = 3.0  # times the support's noise
_MIN_RADIUS_M = 0.04  # of a disc that fits into it: skirts are slim
_LEVEL_M, _LEVEL_SHARE = 0.003, 0.6  # of its cells are this near to its own height: skirts slope
_RIM_FROM, _RIM_TO = 1, 4  # cells inside its outline, of the rim of a dish
_LEAST_DISH_M = 0.002
_MIN_SOLIDITY = 0.75
_BESIDE = 8  # cells across its outline, and a rim along it, within which colors are compared
_EDGE_COLOR, _EDGE_SHARE = 5.0, 0.5
_GROUND_SHARE = 0.5  # of its outline that has the support's level near
_AROUND, _AROUND_SHARE = (
    4,
    0.6,
)  # of the cells around it are no lower than the support: a top has a drop around it
_RIM_HEIGHT_M, _RIM_WIDTH_M = 0.05, 0.075
_RIM_CELLS, _RIM_SHARE = 6, 0.7
_TOUCHING = 0.5  # of its length
_FOOT_M = 0.02


@dataclass(frozen=True)
class _Plan:
    """A support from above, in cells."""

    origin: np.ndarray  # float64 (2,)
    rise: np.ndarray  # float64 (nx, ny) metres over the support's plane; nan where nothing level was seen
    own: np.ndarray  # bool (nx, ny) what is seen there belongs to the carrier
    tall: np.ndarray  # bool (nx, ny) the carrier rises higher there than a flat thing
    samples: SurfaceSamples  # of what is level, without colors

    def mean(self, points: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Return the mean (nx, ny) of the values of points (n, 3) in each cell, nan where there are none."""
        cells, inside = self.cells(points)
        row = np.ravel_multi_index(tuple(cells[inside].T), self.rise.shape)
        number = np.bincount(row, minlength=self.rise.size)
        total = np.bincount(row, weights=values[inside], minlength=self.rise.size)
        return np.where(number > 0, total / np.maximum(number, 1), np.nan).reshape(self.rise.shape)

    def cells(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the cells (n, 2) of points, clipped, and which lie on the grid."""
        cells = np.floor((points[:, :2] - self.origin) / _CELL_M).astype(np.int64)
        inside = ((cells >= 0) & (cells < self.rise.shape)).all(axis=1)
        return np.clip(cells, 0, np.array(self.rise.shape) - 1), inside

    def share_over(self, mask: np.ndarray, points: np.ndarray) -> float:
        """Return the share of points over a mask of cells."""
        cells, inside = self.cells(points)
        return float((inside & mask[cells[:, 0], cells[:, 1]]).mean())


def cut_flats(
    graph: MeshGraph,
    surface: Surface,
    things: list[Thing],
    posed: PosedFrames,
    depth: DepthMaps,
    config: InstancesConfig,
    progress: Progress,
) -> list[Thing]:
    """Cut flat things off what they lie on, join their rims to them, and let what stands in them rest on them.

    Args:
        graph: the surface as a graph.
        surface: the surface in world space.
        things: what was found; theirs are the vertices.
        posed: keyframes with cameras in world space.
        depth: their depth in metres.
        config: what a support is.
        progress: told of how many were cut off.

    Returns:
        The things, flat ones at the end, without those that became their rims.
    """
    out = list(things)
    found = 0
    for carrier in things:
        if carrier.attached or not any(t is carrier for t in out):
            continue
        for support in find_supports(graph, carrier.vertices, config):
            if support.footprint.area_m2 < _MIN_SUPPORT_M2:
                continue
            plan = _plan_of(graph, surface, carrier, support)
            for area in _flat_areas(plan, support):
                if _edge_share(plan, area, _least_rise(support), posed, depth) < _EDGE_SHARE:
                    continue
                out = _with_flat(graph, out, carrier, plan, area, support)
                found += 1
    if found:
        progress.note(f"{found} flat things are cut off what they lie on, by their rise and outline")
    return out


def _plan_of(graph: MeshGraph, surface: Surface, carrier: Thing, support: SupportRegion) -> _Plan:
    inside = support.footprint.contains(graph.points[:, :2], 2)
    near = np.abs(graph.points[:, 2] - support.height_m) < _RIM_HEIGHT_M
    samples = surface_samples(graph, surface, np.flatnonzero(inside & near))
    samples = samples.of(samples.normals[:, 2] > 0.5)
    flat = graph.points[support.vertices, :2]
    size = np.ceil(np.ptp(flat, axis=0) / _CELL_M).astype(int) + 10
    none = np.zeros(tuple(size), bool)
    empty = _Plan(flat.min(axis=0) - 5 * _CELL_M, np.full(none.shape, np.nan), none, none, samples)
    owned = np.zeros(len(graph.points), bool)
    owned[carrier.vertices] = True
    tall = none.copy()
    high = carrier.vertices[graph.points[carrier.vertices, 2] > support.height_m + _MOST_RISE_M]
    cells, on_grid = empty.cells(graph.points[high])
    tall[tuple(cells[on_grid].T)] = True
    return replace(
        empty,
        rise=empty.mean(samples.points, samples.points[:, 2] - _plane_height(graph, support, samples)),
        own=np.nan_to_num(empty.mean(samples.points, owned[samples.vertex].astype(float))) > 0.5,
        tall=tall,
    )


def _plane_height(graph: MeshGraph, support: SupportRegion, samples: SurfaceSamples) -> np.ndarray:
    """Return the height of the support's plane below each sample: it may lean a little."""
    points = graph.points[support.vertices]
    for _ in range(3):
        fit = np.linalg.lstsq(np.c_[points[:, :2], np.ones(len(points))], points[:, 2], rcond=None)[0]
        off = np.abs(np.c_[points[:, :2], np.ones(len(points))] @ fit - points[:, 2])
        points = points[off <= max(2.0 * float(np.median(off)), 1e-4)]
    return np.c_[samples.points[:, :2], np.ones(len(samples.points))] @ fit


def _least_rise(support: SupportRegion) -> float:
    return max(_LEAST_RISE_M, _NOISE * support.noise_m)


def _flat_areas(plan: _Plan, support: SupportRegion) -> list[np.ndarray]:
    """Return masks of cells, without holes, that look like flat things in shape and belong to the carrier so far."""
    least = _least_rise(support)
    with np.errstate(invalid="ignore"):
        raised = plan.own & ~plan.tall & (plan.rise > least) & (plan.rise < _MOST_RISE_M)
    raised = ndimage.binary_opening(ndimage.binary_closing(np.pad(raised, 2)), iterations=1)[2:-2, 2:-2]
    label, count = ndimage.label(raised)
    areas = []
    for number in range(1, count + 1):
        area = ndimage.binary_fill_holes(label == number)
        if area.sum() * _CELL_M**2 >= _MIN_FLAT_M2 and _is_flat_thing(plan, area, least):
            areas.append(area)
    return areas


def _is_flat_thing(plan: _Plan, area: np.ndarray, least: float) -> bool:
    if ndimage.distance_transform_edt(np.pad(area, 1)).max() * _CELL_M < _MIN_RADIUS_M:
        return False
    if area.sum() < _MIN_SOLIDITY * filled_hull(area).sum():
        return False
    if not (_is_level(plan.rise[area & plan.own]) or _is_dished(plan, area)):
        return False
    around = ndimage.binary_dilation(area, iterations=_AROUND) & ~area
    with np.errstate(invalid="ignore"):
        return bool((plan.rise[around] > -least).mean() >= _AROUND_SHARE)


def _is_level(rise: np.ndarray) -> bool:
    rise = rise[np.isfinite(rise)]
    return bool((np.abs(rise - np.median(rise)) < _LEVEL_M).mean() >= _LEVEL_SHARE) if len(rise) else False


def _is_dished(plan: _Plan, area: np.ndarray) -> bool:
    """Return whether an area has a level rim that is higher than its middle: skirts fall off outwards."""
    inside = ndimage.distance_transform_edt(np.pad(area, 1))[1:-1, 1:-1]
    own = plan.own & np.isfinite(plan.rise)
    rim = plan.rise[own & (inside > _RIM_FROM) & (inside <= _RIM_TO)]
    middle = plan.rise[own & (inside > _RIM_TO)]
    if not len(middle) or not _is_level(rim):
        return False
    return bool(np.median(rim) > np.median(middle) + _LEAST_DISH_M)


def _edge_share(plan: _Plan, area: np.ndarray, least: float, posed: PosedFrames, depth: DepthMaps) -> float:
    """Return the share of an outline across which the color changes, or along which a line of another color runs."""
    reach = ndimage.distance_transform_edt(~area) <= _BESIDE + 1
    cells, inside = plan.cells(plan.samples.points)
    samples = with_colors(plan.samples.of(inside & reach[cells[:, 0], cells[:, 1]]), posed, depth)
    samples = samples.of(np.isfinite(samples.lab[:, 0]))
    lab = np.stack(
        [plan.mean(samples.points, samples.lab[:, k] * LIGHTNESS_WEIGHT[k]) for k in range(3)], axis=-1
    )
    seen = np.isfinite(lab[..., 0])
    border = area & ~ndimage.binary_erosion(area)
    with np.errstate(invalid="ignore"):
        ground = seen & ~ndimage.binary_dilation(area) & (np.abs(plan.rise) < 0.5 * least)
    inner = seen & ndimage.binary_erosion(area, iterations=2)
    rim = seen & ndimage.binary_dilation(border, iterations=2) & ~inner
    ground_lab, inner_lab, rim_lab = (_beside(lab, side, border) for side in (ground, inner, rim))
    if np.isfinite(ground_lab[:, 0]).mean() < _GROUND_SHARE:
        return 0.0
    to_ground = np.linalg.norm(rim_lab - ground_lab, axis=1)
    line = np.minimum(to_ground, np.linalg.norm(rim_lab - inner_lab, axis=1))
    step = np.fmax(np.linalg.norm(ground_lab - inner_lab, axis=1), line)
    step = step[np.isfinite(step)]
    return float((step > _EDGE_COLOR).mean()) if len(step) else 0.0


def _beside(lab: np.ndarray, side: np.ndarray, border: np.ndarray) -> np.ndarray:
    """Return the mean color (n, 3) of the cells of a side nearest to each cell of a border, nan where none is near."""
    cells, there = np.argwhere(border), np.argwhere(side)
    if len(there) == 0:
        return np.full((len(cells), 3), np.nan)
    gap, index = cKDTree(there).query(cells, k=4, distance_upper_bound=_BESIDE)
    weight = np.isfinite(gap).astype(float)[..., None]
    values = lab[tuple(there[np.minimum(index, len(there) - 1)].transpose(2, 0, 1))]
    total = weight.sum(axis=1)
    return np.where(total > 0, (weight * values).sum(axis=1) / np.maximum(total, 1), np.nan)


def _with_flat(
    graph: MeshGraph,
    things: list[Thing],
    carrier: Thing,
    plan: _Plan,
    area: np.ndarray,
    support: SupportRegion,
) -> list[Thing]:
    """Return the things with a flat one cut off its carrier."""
    grown = ndimage.binary_dilation(area, iterations=1)
    points = graph.points[carrier.vertices]
    cells, inside = plan.cells(points)
    rise = points[:, 2] - support.height_m
    taken = inside & grown[cells[:, 0], cells[:, 1]] & (rise > 0.5 * _LEAST_RISE_M) & (rise < _RIM_HEIGHT_M)
    flat = Thing(carrier.vertices[taken], carrier, carrier.depth + 1)
    carrier.vertices = carrier.vertices[~taken]
    beside = [thing for thing in things if thing.rests_on is carrier and not thing.attached]
    for rim in [thing for thing in beside if _is_rim(graph, plan, area, thing, support)]:
        things = join(things, rim, flat)
    for thing in things:
        if thing.rests_on is carrier and not thing.attached:
            points = graph.points[thing.vertices]
            foot = points[points[:, 2] < points[:, 2].min() + _FOOT_M]
            if plan.share_over(area, foot) > 0.5:
                thing.rests_on = flat
    return [*things, flat]


def _is_rim(graph: MeshGraph, plan: _Plan, area: np.ndarray, thing: Thing, support: SupportRegion) -> bool:
    """Tell whether a low, slim thing runs along the outline of a flat area."""
    points = graph.points[thing.vertices]
    if np.percentile(points[:, 2], 98) > support.height_m + _RIM_HEIGHT_M:
        return False
    near = ndimage.binary_dilation(area, iterations=_RIM_CELLS)
    if plan.share_over(near & ~ndimage.binary_erosion(area, iterations=2), points) < _RIM_SHARE:
        return False
    cells, _ = plan.cells(points)
    mask = np.zeros(area.shape, bool)
    mask[cells[:, 0], cells[:, 1]] = True
    mask = ndimage.binary_closing(np.pad(mask, 2))[2:-2, 2:-2]
    touching = (ndimage.binary_dilation(area, iterations=2) & mask).sum()
    width = 2.0 * ndimage.distance_transform_edt(np.pad(mask, 1)).max()
    length = np.ptp(cells, axis=0).max() + 1
    return bool(width * _CELL_M < _RIM_WIDTH_M and touching > _TOUCHING * length)
