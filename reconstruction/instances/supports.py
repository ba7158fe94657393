"""Up-facing planar regions that carry things, and the test whether something stands on one or belongs to it."""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import binary_dilation, binary_erosion, binary_fill_holes
from scipy.spatial import cKDTree

from reconstruction.instances.config import InstancesConfig
from reconstruction.instances.outlines import filled_hull, filled_polygon
from reconstruction.surface.levels import horizontal_levels, joined_levels
from reconstruction.surface.mesh_graph import MeshGraph

_MAX_GOES_ON = 0.4  # share of the known foot of a thing along which its side may go on below its support


@dataclass(frozen=True)
class Footprint:
    """A region of the ground plan as a grid of cells."""

    origin: np.ndarray  # float64 (2,)
    cell_m: float
    filled: np.ndarray  # bool (nx, ny) outline with holes and bays filled
    occupied: np.ndarray  # bool (nx, ny) where surface was seen

    @classmethod
    def of(cls, points_xy: np.ndarray, cell_m: float) -> "Footprint":
        """Rasterize points (n, 2); a nearly convex shape is filled to its convex hull."""
        margin = 4
        origin = points_xy.min(axis=0) - margin * cell_m
        cells = np.floor((points_xy - origin) / cell_m).astype(np.int32)
        occupied = np.zeros(cells.max(axis=0) + margin + 1, np.uint8)
        occupied[cells[:, 0], cells[:, 1]] = 1
        kernel = np.ones((3, 3), np.uint8)
        occupied = cv2.morphologyEx(occupied, cv2.MORPH_CLOSE, kernel).astype(bool)
        hull = cv2.convexHull(np.ascontiguousarray(cells[:, ::-1]))
        convex = filled_polygon(occupied.shape, hull)
        filled = binary_fill_holes(occupied)
        if filled.sum() >= 0.5 * convex.sum():
            filled = filled | convex
        else:  # an L-shaped top, or one full of holes: bridge what things standing on it hide
            radius = max(1, round(0.06 / cell_m))
            disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1,) * 2)
            padded = np.pad(filled.astype(np.uint8), radius)
            closed = cv2.morphologyEx(padded, cv2.MORPH_CLOSE, disc)[radius:-radius, radius:-radius]
            filled = binary_fill_holes(closed > 0)
        return cls(origin, cell_m, filled, occupied)

    @property
    def area_m2(self) -> float:
        """Return the filled area."""
        return float(self.filled.sum()) * self.cell_m**2

    def contains(self, points_xy: np.ndarray, margin_cells: int = 0) -> np.ndarray:
        """Return which points (n, 2) lie over the filled region, grown by some cells."""
        grid = binary_dilation(self.filled, iterations=margin_cells) if margin_cells else self.filled
        cells = np.floor((points_xy - self.origin) / self.cell_m).astype(np.int64)
        inside = ((cells >= 0) & (cells < grid.shape)).all(axis=1)
        out = np.zeros(len(cells), bool)
        out[inside] = grid[cells[inside, 0], cells[inside, 1]]
        return out


@dataclass(frozen=True)
class SupportRegion:
    """One horizontal up-facing region."""

    vertices: np.ndarray  # int (n,) sorted
    height_m: float
    noise_m: float  # robust spread of its heights
    footprint: Footprint
    lab: np.ndarray  # float64 (3,) median color


def find_supports(graph: MeshGraph, chosen: np.ndarray, config: InstancesConfig) -> list[SupportRegion]:
    """Find the horizontal up-facing regions among vertices `chosen`, lowest first."""
    merged = _merge_levels(graph, horizontal_levels(graph, chosen, 0.1 * config.min_support_area_m2))
    regions = []
    for piece in merged:
        if graph.areas[piece].sum() < config.min_support_area_m2:
            continue
        z = graph.points[piece, 2]
        height = float(np.median(z))
        noise = 1.4826 * float(np.median(np.abs(z - height)))
        # Noise tilts normals: for the outline every roughly level vertex at this height counts, if near the rest.
        level = chosen[(np.abs(graph.points[chosen, 2] - height) < 0.012) & (graph.normals[chosen, 2] > 0.5)]
        gap, _ = cKDTree(graph.points[piece, :2]).query(graph.points[level, :2], distance_upper_bound=0.1)
        outline = np.union1d(piece, level[np.isfinite(gap)])
        footprint = Footprint.of(graph.points[outline, :2], max(0.01, graph.spacing_m))
        regions.append(SupportRegion(piece, height, noise, footprint, np.median(graph.lab[piece], axis=0)))
    return sorted(regions, key=lambda region: (region.height_m, int(region.vertices[0])))


def _merge_levels(graph: MeshGraph, levels: list[np.ndarray]) -> list[np.ndarray]:
    """Join regions of the same height whose outlines are near: things standing between them hide the rest."""
    boxes = [
        (graph.points[p].min(axis=0)[:2], graph.points[p].max(axis=0)[:2], np.median(graph.points[p, 2]))
        for p in levels
    ]
    colors = [np.median(graph.lab[p], axis=0) for p in levels]

    def of_one(i: int, j: int) -> bool:
        apart = np.maximum(boxes[i][0] - boxes[j][1], boxes[j][0] - boxes[i][1]).max()
        rise = abs(boxes[i][2] - boxes[j][2])
        gap = np.abs(colors[i] - colors[j]).max()
        alike = gap < (
            25 if rise < 0.006 else 12
        )  # the bottom of a tray is a little higher, and of another color
        return bool(alike and ((rise < 0.012 and apart < 0.06) or (rise < 0.008 and apart < 0.25)))

    return joined_levels(levels, of_one)


def stands_on(
    graph: MeshGraph,
    body: np.ndarray,
    support: SupportRegion,
    candidate: np.ndarray,
    level_m: float,
    config: InstancesConfig,
) -> bool:
    """Decide whether `candidate`, a piece of `body` above a support plane, is a separate thing standing on it."""
    level = support.height_m + level_m
    points = graph.points[candidate]
    step = max(0.012, 1.5 * graph.spacing_m)
    foot = points[points[:, 2] < max(level, points[:, 2].min()) + step]
    if points[:, 2].min() > level + 0.02 or len(foot) < 3:
        return False
    if support.footprint.contains(foot[:, :2], 2).mean() < 0.5:
        return False
    extents = points.max(axis=0) - points.min(axis=0)
    if np.sort(extents)[1] < config.min_object_m or len(candidate) < config.min_object_vertices:
        return False
    color_gap = float(np.linalg.norm(median_color(graph, candidate) - median_color(graph, support.vertices)))
    rise = float(np.percentile(points[:, 2], 95)) - support.height_m
    if rise < max(0.015, support.noise_m) or _is_bump(graph, candidate, rise, color_gap, support.noise_m):
        return False  # a bump of the support itself
    return not _belongs_to_body(graph, body, support, candidate, foot, color_gap)


def _is_bump(graph: MeshGraph, candidate: np.ndarray, rise: float, color_gap: float, noise_m: float) -> bool:
    """Tell swellings of a noisy support, low, of its color, wide or without steep sides, from flat things."""
    extents = np.sort(np.ptp(graph.points[candidate, :2], axis=0))
    if rise > max(0.025, 12.0 * noise_m) and extents[1] < 0.25 and rise > 0.2 * extents[1]:
        return False  # far above what this support's noise could raise, and compact
    if rise < 0.035 and extents[1] > 0.6:
        return True  # a sheet of stray surface along an edge
    if rise > 0.055 or color_gap > 10.0:
        return False
    steep = float((graph.normals[candidate, 2] < 0.5).mean())
    return rise < 0.02 or steep < 0.15 or extents[1] > 0.25 or rise < 0.12 * extents[0]


def contact_height(support: SupportRegion, config: InstancesConfig) -> float:
    """Return how far above a support plane a separate thing begins."""
    return float(np.clip(3.0 * support.noise_m, config.contact_height_m, 0.02))


def _belongs_to_body(
    graph: MeshGraph,
    body: np.ndarray,
    support: SupportRegion,
    candidate: np.ndarray,
    foot: np.ndarray,
    color_gap: float,
) -> bool:
    """Tell sides, backs, rims and posts, which continue the body, from things put onto it."""
    cell = support.footprint.cell_m
    foot_print = Footprint.of(foot[:, :2], cell)
    whole = Footprint.of(graph.points[candidate, :2], cell)
    ratio = foot_print.area_m2 / max(support.footprint.area_m2, 1e-6)
    # Seen support within the foot's outline: a ring (rim, sides), not a thing, which would hide what it stands on.
    convex = _convex(foot_print)
    if convex.area_m2 > 0.55 * support.footprint.area_m2:
        # A foot hides what it stands on; its outline is drawn in, for things widen above their foot.
        inset = max(1, round(0.25 * np.sqrt(convex.area_m2 / np.pi) / cell))
        core = binary_erosion(convex.filled, iterations=inset)
        inside = Footprint(convex.origin, cell, core, core).contains(graph.points[support.vertices, :2])
        if graph.areas[support.vertices[inside]].sum() > 0.45 * max(core.sum(), 1) * cell**2:
            return True
    short_side = float(np.ptp(graph.points[support.vertices, :2], axis=0).min())
    edge_cells = max(2, round(min(0.05, 0.2 * short_side) / cell))
    core = binary_erosion(support.footprint.filled, iterations=edge_cells)
    inner_print = Footprint(support.footprint.origin, cell, core, core)
    rests, goes_on = contact_shares(graph, body, support, candidate)
    surrounds = goes_on > 0.5 and rests < 0.1  # a rim around what lies in it, whatever the colors
    if surrounds or (goes_on > max(_MAX_GOES_ON * (rests + goes_on), 0.15) and color_gap < 30.0):
        return True  # along much of its foot the same side goes on downwards, past the support
    if rests > 0.5 and rests > 8.0 * goes_on and not _is_post(graph, candidate):
        return False
    # Posts, arms and rims: the body's color, slim or along the edge of the support.
    gap = min(color_gap, _gap_to_sides(graph, body, support, candidate, foot))
    if gap < 9.0:
        slim = float(np.sort(np.ptp(graph.points[candidate], axis=0)[:2])[0]) < 0.05
        plan = np.sort(np.ptp(graph.points[candidate, :2], axis=0))
        strip = gap < 6.0 and plan[0] < 0.6 * plan[1]
        if slim or strip or inner_print.contains(foot[:, :2]).mean() < 0.5:
            return True
    # A back or arm: as long as the support, the same color, and larger than things usually are.
    span = span_ratio(graph, support, candidate)
    overhang = 1.0 - support.footprint.contains(graph.points[candidate, :2], 2).mean()
    if (
        span > 0.6
        and color_gap < 12.0
        and (whole.area_m2 > 0.8 * support.footprint.area_m2 or overhang > 0.25)
    ):
        return True
    return ratio > 0.9 and color_gap < 8.0


def contact_shares(
    graph: MeshGraph, body: np.ndarray, support: SupportRegion, candidate: np.ndarray
) -> tuple[float, float]:
    """Return along what shares of a candidate's foot the support begins right outside it, and its side goes on below.

    The rest of the foot is at holes of the surface or at other things. Sides of a container or the back of a seat stand
    on the support inside, but go on below it outside; a thing that was put down stands on it all around.
    """
    inside = np.zeros(len(graph.points), bool)
    inside[candidate] = True
    of_body = np.zeros(len(graph.points), bool)
    of_body[body] = True
    edges = graph.edges[(inside[graph.edges].sum(axis=1) == 1) & of_body[graph.edges].all(axis=1)]
    foot = np.unique(edges[inside[edges]])
    foot = foot[graph.points[foot, 2] < support.height_m + 0.06]
    if len(foot) == 0:
        return 0.0, 0.0
    outward = graph.normals[foot, :2]
    outward = outward / np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-9)
    z = graph.points[body, 2] - support.height_m
    level = body[(np.abs(z) < 0.012) & (graph.normals[body, 2] > 0.75)]
    level = level[~_encloses(graph, foot, level)]
    side = body[(z < -0.012) & (z > -0.06) & (np.abs(graph.normals[body, 2]) < 0.6)]
    rests = _reached(graph, foot, outward, level, 0.04, lambda step, out, _: (step * out).sum(axis=1) > 0.004)
    goes_on = _reached(
        graph, foot, outward, side, 0.025, lambda _, out, normal: (normal * out).sum(axis=1) > 0.5
    )
    return float((rests & ~goes_on).mean()), float((goes_on & ~rests).mean())


def _encloses(graph: MeshGraph, foot: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return which of `others` lie within the outline of a foot, a centimetre or more inside."""
    hull = cv2.convexHull(graph.points[foot, :2].astype(np.float32))
    flat = graph.points[others, :2]
    low, high = hull.min(axis=(0, 1)), hull.max(axis=(0, 1))
    out = ((flat > low) & (flat < high)).all(axis=1)
    for row in np.flatnonzero(out):
        out[row] = cv2.pointPolygonTest(hull, (float(flat[row, 0]), float(flat[row, 1])), True) > 0.01
    return out


def _reached(
    graph: MeshGraph,
    foot: np.ndarray,
    outward: np.ndarray,
    targets: np.ndarray,
    reach_m: float,
    fits: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray],
) -> np.ndarray:
    """Return which foot vertices have a fitting target near; `fits` gets steps, outward and normals in plan."""
    out = np.zeros(len(foot), bool)
    if len(targets) == 0:
        return out
    near = cKDTree(graph.points[targets, :2]).query_ball_point(
        graph.points[foot, :2], reach_m, return_sorted=True
    )
    rows = np.repeat(np.arange(len(foot)), [len(n) for n in near])
    if len(rows) == 0:
        return out
    chosen = targets[np.concatenate([np.asarray(n, np.int64) for n in near if n])]
    step = graph.points[chosen, :2] - graph.points[foot[rows], :2]
    out[rows[fits(step, outward[rows], graph.normals[chosen, :2])]] = True
    return out


def _is_post(graph: MeshGraph, candidate: np.ndarray) -> bool:
    """A slim upright on a support may be a part of it: a post, a divider."""
    extents = np.ptp(graph.points[candidate], axis=0)
    return bool(extents[:2].min() < 0.05 and extents[2] > 0.15)


def _gap_to_sides(
    graph: MeshGraph, body: np.ndarray, support: SupportRegion, candidate: np.ndarray, foot: np.ndarray
) -> float:
    """Return the color distance to what of the body lies below the support plane near the foot; inf if nothing."""
    z = graph.points[body, 2]
    below = body[(z < support.height_m - 0.012) & (z > support.height_m - 0.15)]
    if len(below) == 0:
        return float("inf")
    distance, _ = cKDTree(foot[:, :2]).query(graph.points[below, :2], distance_upper_bound=0.04)
    near = below[np.isfinite(distance)]
    if len(near) < 10:
        return float("inf")
    return float(np.linalg.norm(median_color(graph, near) - median_color(graph, candidate)))


def _convex(footprint: Footprint) -> Footprint:
    filled = filled_hull(footprint.occupied)
    return Footprint(footprint.origin, footprint.cell_m, filled, footprint.occupied)


def span_ratio(graph: MeshGraph, support: SupportRegion, candidate: np.ndarray) -> float:
    """Return how much of the support's longer or shorter side the candidate spans, whichever is more."""
    base = np.ptp(graph.points[support.vertices, :2], axis=0)
    return float((np.ptp(graph.points[candidate, :2], axis=0) / np.maximum(base, 1e-6)).max())


def median_color(graph: MeshGraph, vertices: np.ndarray) -> np.ndarray:
    """Return the median CIELAB color, lightness at half weight because shading changes it."""
    return np.median(graph.lab[vertices], axis=0) * [0.5, 1, 1]
