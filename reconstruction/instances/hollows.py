"""Open containers on a support, whole: what a closed rim encloses in plan, with the rim, seen from above.

Bowls, baskets, trays and open boxes come in pieces: their low floor looks like a part of the support, and their sides
like walls of it or like several things. From above they are plain: a closed ring that rises to one height on all sides
around lower ground.
"""

import cv2
import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from reconstruction.instances.boxes import quantiles
from reconstruction.instances.convexity import MIN_BULGE, bulge, is_within
from reconstruction.instances.outlines import filled_hull, inset
from reconstruction.instances.supports import SupportRegion
from reconstruction.surface.mesh_graph import MeshGraph

_RIMS_M = (0.08, 0.055, 0.035, 0.022, 0.014)  # heights above the support at which a closed ring is looked for
_RAISED_M = 0.006
_MAX_RISE_M = 0.3
_TALL = 0.8  # of that: the sides of a stack that rises beyond it
_COVERED = 0.5  # of what they enclose: under the top of the stack
_GAP_M = 0.03  # in a rim, bridged
_MIN_HOLE_M2 = 0.003
_MAX_SIDE_M, _MAX_SHARE = 0.8, 0.5  # of a container, and of its support's outline
_OVERLAP = 0.1  # of two containers that touch
_CONVEX = 0.9  # share of its convex hull that a free-standing container fills
_RIM_WIDTH_M = 0.08
_OUTSIDE = 0.5  # share of an outline around which nothing is raised, if it is that of the container
_EDGE_M, _SKIRT_M, _SUNK_M = 0.02, 0.004, 0.015
_DEEP_M = 0.007  # how far the rim rises above the ground that it encloses
_SECTORS, _EVEN_M, _MIN_EVEN = 24, 0.012, 0.6  # directions in which the rim has one height
_BULGE, _MAX_CONTENT = 0.42, 0.5  # of contents: shape, and share of the container's outline
_MIN_CONTENT_M, _RIM_REACH_M, _MIN_INNER = 0.025, 0.025, 0.85
_LOW_SHARE, _WIDER, _PLATE_M = 0.4, 1.35, 0.012  # of what a container stands on
_OTHER_COLOR, _WIDER_OTHER = 20.0, 1.15  # CIELAB; skirts make the upper part wider than it is
_TOUCH_M, _CLINGS_M, _OWN_BULGE = 0.015, 0.06, 0.6  # of a handle or a skirt
_BESIDE_M, _ALIKE = 0.04, 7.0
_MAX_FILLED = 0.75  # share of the outline that rises to the rim


def hollows_on(graph: MeshGraph, body: np.ndarray, support: SupportRegion) -> list[np.ndarray]:
    """Return the open containers, with what is in them, among vertices `body` (sorted) that stand on `support`."""
    plan = _Plan(graph, body, support)
    taken = np.zeros(plan.rise.shape, bool)
    found = []
    for rim_m in _RIMS_M:
        for outline in plan.containers(rim_m):
            if (outline & taken).sum() > _OVERLAP * outline.sum():
                continue
            outline = outline & ~taken
            taken |= outline
            found.append(plan.within(outline))
    return [part for part in found if len(part)]


class _Plan:
    """What rises above a support, from above, in cells."""

    def __init__(self, graph: MeshGraph, body: np.ndarray, support: SupportRegion) -> None:
        self.cell_m = max(0.01, graph.spacing_m)
        self.limit_m2 = _MAX_SHARE * support.footprint.area_m2
        rise = graph.points[body, 2] - support.height_m
        near = support.footprint.contains(graph.points[body, :2], 4)
        self.body, self.height = body[near], rise[near]
        flat = graph.points[self.body, :2]
        origin = flat.min(axis=0) if len(flat) else np.zeros(2)
        self.cells = np.floor((flat - origin) / self.cell_m).astype(np.int64) + 4
        shape = tuple(self.cells.max(axis=0) + 5) if len(flat) else (1, 1)
        self.rise = np.full(shape, -1.0)  # of the highest surface in each cell; -1 = none was seen
        low = (self.height < _MAX_RISE_M) & (self.height > -0.03)
        np.maximum.at(self.rise, (self.cells[low, 0], self.cells[low, 1]), self.height[low])
        self.higher = np.zeros(shape, bool)  # cells with something above what is looked at
        self.higher[tuple(self.cells[self.height >= _MAX_RISE_M].T)] = True

    def containers(self, rim_m: float) -> list[np.ndarray]:
        """Return the outlines, as masks of cells, of what has a closed rim at a height."""
        radius = max(1, round(0.5 * _GAP_M / self.cell_m))
        high = self.rise > rim_m
        ring = ndimage.binary_closing(high, _disc(radius)) | high
        filled = ndimage.binary_fill_holes(ring)
        hollow = filled & ~ring & ~self._cut_open(filled & ~ring)
        out = []
        label, count = ndimage.label(filled)
        for number in range(1, count + 1):
            region = label == number
            hole = region & hollow
            # Free-standing ones have convex outlines; of one that touches others its hole is grown over the rim.
            if region.sum() > _CONVEX * filled_hull(region).sum():
                tries = [(region, hole)]
            else:
                parts, many = ndimage.label(hole)
                tries = [(hole, hole)] + [(parts == k, parts == k) for k in range(1, many + 1) if many > 1]
            for start, inside in tries:
                if inside.sum() * self.cell_m**2 < _MIN_HOLE_M2:
                    continue
                outline = self._outline(filled_hull(start))
                if outline is not None and self._is_container(outline, inside):
                    out.append(outline)
                    break
        return out

    def _cut_open(self, hollow: np.ndarray) -> np.ndarray:
        """Return which hollows are the inside of something that rises beyond what is looked at: its top is missing."""
        label, count = ndimage.label(hollow)
        out = np.zeros(hollow.shape, bool)
        for number in range(1, count + 1):
            hole = label == number
            around = ndimage.binary_dilation(hole, np.ones((3, 3))) & ~hollow & (self.rise > -1.0)
            walls = around.any() and np.median(self.rise[around]) > _TALL * _MAX_RISE_M
            if walls and self.higher[hole].mean() > _COVERED:
                out |= hole
        return out

    def _outline(self, hull: np.ndarray) -> np.ndarray | None:
        """Grow a hull over the rim until most of what is around is not raised."""
        grown = hull
        raised = self.rise > _RAISED_M
        for _ in range(max(2, round(_RIM_WIDTH_M / self.cell_m))):
            larger = ndimage.binary_dilation(grown)
            around = larger & ~grown
            if (raised & around).sum() < _OUTSIDE * around.sum():
                return grown
            grown = larger
        return None

    def _is_container(self, outline: np.ndarray, hole: np.ndarray) -> bool:
        """Tell whether the rim is of one height in most directions, and higher than the ground inside."""
        sides = np.ptp(np.argwhere(outline), axis=0) * self.cell_m
        if outline.sum() * self.cell_m**2 > self.limit_m2 or sides.max() > _MAX_SIDE_M:
            return False
        rows, columns = np.nonzero(outline & ~hole & (self.rise > _RAISED_M))
        inside = self.rise[hole & (self.rise > -1.0)]
        if len(rows) < _SECTORS or len(inside) < 5:
            return False
        center = np.argwhere(hole).mean(axis=0)
        angle = np.arctan2(columns - center[1], rows - center[0])
        sector = np.floor((angle + np.pi) / (2 * np.pi) * _SECTORS).astype(int) % _SECTORS
        crest = np.full(_SECTORS, np.nan)
        for k in np.unique(sector):
            crest[k] = self.rise[rows, columns][sector == k].max()
        rim = float(np.nanmedian(crest))
        slack = max(_EVEN_M, 0.25 * rim)
        even = np.abs(crest - rim) < slack
        known = ~(crest > rim + slack)  # things stand before the others
        deep = rim - float(np.median(inside)) > _DEEP_M
        filled = (self.rise[outline] > rim - 0.3 * (rim - float(np.median(inside)))).mean()
        return bool(
            deep and even.sum() > _MIN_EVEN * known.sum() and known.mean() > 0.5 and filled < _MAX_FILLED
        )

    def within(self, outline: np.ndarray) -> np.ndarray:
        """Return the vertices of the body over an outline: near its edge what is raised, further in the bottom, too."""
        inner = ndimage.binary_erosion(outline, iterations=max(1, round(_EDGE_M / self.cell_m)))
        row, column = self.cells.T
        ground = np.where(inner[row, column], -_SUNK_M, _SKIRT_M)
        return self.body[outline[row, column] & (self.height > ground)]


def shell_and_contents(
    graph: MeshGraph, body: np.ndarray, parts: list[np.ndarray]
) -> tuple[list[int], list[int], list[int]]:
    """Sort the parts that a container was cut into: what it stands on (a plate), its own parts, and what is in it.

    Args:
        graph: the surface.
        body: sorted vertices of all of it.
        parts: vertices of each part.

    Returns:
        Rows of `parts`: wider parts below, parts of the container, contents. What lies beside a container on something
        wider, its skirt, is none of them.
    """
    whole = _hull_m2(graph, body)
    contents = [k for k, part in enumerate(parts) if _has_own_shape(graph, part, body, whole)]
    own = [k for k in range(len(parts)) if k not in contents]
    z = graph.points[body, 2]
    low, high = np.percentile(z, [2, 98])
    under = [k for k in own if np.median(graph.points[parts[k], 2]) < low + _LOW_SHARE * (high - low)]
    upper = [parts[k] for k in own if k not in under]
    above = np.concatenate(upper) if upper else body
    narrow = _hull_m2(graph, above)
    color = np.median(graph.lab[above], axis=0)
    under = [
        k
        for k in under
        if _hull_m2(graph, parts[k]) > narrow * (_WIDER if _alike(graph, parts[k], color) else _WIDER_OTHER)
        and np.ptp(graph.points[parts[k], 2]) > _PLATE_M
    ]
    own = [k for k in own if k not in under]
    if under and own:
        main = max(own, key=lambda k: graph.areas[parts[k]].sum())
        own = [k for k in own if k == main or is_within(graph, parts[k], parts[main])]
    return under, own, contents


def _alike(graph: MeshGraph, part: np.ndarray, lab: np.ndarray) -> bool:
    """Tell whether a part has the color (3,), CIELAB, of what is above it: a foot of the thing itself, perhaps."""
    return bool(np.linalg.norm(np.median(graph.lab[part], axis=0) - lab) < _OTHER_COLOR)


def clings_to(graph: MeshGraph, part: np.ndarray, container: np.ndarray) -> bool:
    """Tell whether a part beside a container is a handle of it or the skirt behind it, and no thing."""
    if bulge(graph, part) > _OWN_BULGE or _top(graph, part) > _top(graph, container) + _EVEN_M:
        return False
    if (
        cKDTree(graph.points[container]).query(graph.points[part], distance_upper_bound=_TOUCH_M)[0].min()
        > 1.0
    ):
        return False
    hull = cv2.convexHull(graph.points[container, :2].astype(np.float32))
    away = -inset(hull, graph.points[part, :2])
    return float(quantiles(away, graph.areas[part], (0.8,))[0]) < _CLINGS_M


def looks_like(graph: MeshGraph, part: np.ndarray, container: np.ndarray) -> bool:
    """Tell whether a part has the color that a container has beside it."""
    gap = cKDTree(graph.points[part]).query(graph.points[container], distance_upper_bound=_BESIDE_M)[0]
    near = container[np.isfinite(gap)]
    if len(near) == 0:
        return False
    step = np.median(graph.lab[part], axis=0) - np.median(graph.lab[near], axis=0)
    return float(np.linalg.norm(step)) < _ALIKE


def _top(graph: MeshGraph, vertices: np.ndarray) -> float:
    return float(quantiles(graph.points[vertices, 2], graph.areas[vertices], (0.98,))[0])


def _has_own_shape(graph: MeshGraph, part: np.ndarray, body: np.ndarray, whole_m2: float) -> bool:
    """Contents bulge, or rise amid the container without touching its rim."""
    if _hull_m2(graph, part) > _MAX_CONTENT * whole_m2:
        return False
    turn = bulge(graph, part)
    if turn > _BULGE:
        return True
    if turn < MIN_BULGE or np.ptp(graph.points[part, 2]) < _MIN_CONTENT_M:
        return False
    hull = cv2.convexHull(graph.points[body, :2].astype(np.float32))
    return float(np.mean(inset(hull, graph.points[part, :2]) > _RIM_REACH_M)) > _MIN_INNER


def _hull_m2(graph: MeshGraph, vertices: np.ndarray) -> float:
    return float(cv2.contourArea(cv2.convexHull(graph.points[vertices, :2].astype(np.float32))))


def _disc(radius: int) -> np.ndarray:
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1,) * 2) > 0
