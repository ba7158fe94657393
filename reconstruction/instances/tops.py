"""Two pieces of furniture side by side, joined by noise in the gap between them, are cut apart along that gap.

Tables, benches and cabinets that stand a few centimetres apart come as one piece of surface: depth smears over the gap.
Their tops tell: two large level regions, neither over the other, with a gap between them into which one looks down.
"""

import cv2
import numpy as np
from scipy import ndimage

from reconstruction.instances.outlines import filled_hull, filled_polygon
from reconstruction.surface.mesh_graph import MeshGraph

_CELL_M = 0.02
_LEVEL = 0.8  # z of the normals of a top
_STEP_M = 0.006  # of the heights of neighboring cells of one top
_MIN_TOP_M2 = 0.1
_MIN_HEIGHT_M = 0.2
_GAP_M = (0.05, 0.25)  # narrower is a joint of one top, wider gaps are not bridged by noise
_MAX_OVERLAP = 0.05  # of the smaller outline
_MAX_COVERED = 0.6  # share of the gap over which level surface lies, higher than half the tops
_MIN_STRIP_M = 0.25  # length of the gap


def cut_between_tops(graph: MeshGraph, body: np.ndarray) -> list[np.ndarray]:
    """Return the parts of `body` (sorted indices), one for each group of tops with gaps around it; mostly one."""
    if graph.areas[body].sum() < 2 * _MIN_TOP_M2:
        return [body]
    plan = _Plan(graph, body)
    count = len(plan.outlines)
    group = list(range(count))
    for i in range(count):
        for j in range(i + 1, count):
            if not plan.apart(i, j):
                low, high = sorted((group[i], group[j]))
                group = [low if g == high else g for g in group]
    names = sorted(set(group))
    if len(names) < 2:
        return [body]
    nearest = plan.nearest([[k for k in range(count) if group[k] == name] for name in names])
    return [body[nearest == k] for k in range(len(names))]


class _Plan:
    """A body from above, in cells, with the convex outlines of its large tops."""

    def __init__(self, graph: MeshGraph, body: np.ndarray) -> None:
        points = graph.points[body]
        cells = np.floor((points[:, :2] - points[:, :2].min(axis=0)) / _CELL_M).astype(np.int64) + 2
        self.cells = cells
        level = (graph.normals[body, 2] > _LEVEL) & (points[:, 2] > _MIN_HEIGHT_M)
        self.heights = np.full(tuple(cells.max(axis=0) + 3), -1.0)  # of the highest level surface, -1 = none
        np.maximum.at(self.heights, (cells[level, 0], cells[level, 1]), points[level, 2])
        self.outlines: list[np.ndarray] = []
        self.height: list[float] = []
        self.away: list[np.ndarray] = []  # metres from the outline
        self.away_from_whole: list[np.ndarray] = []  # and from its rectangle: things hide corners of a top
        for top in _tops(self.heights):
            at = np.argwhere(top)[:, ::-1].astype(np.int32)
            self.outlines.append(filled_hull(top))
            self.height.append(float(np.median(self.heights[top & (self.heights > 0)])))
            corners = cv2.boxPoints(cv2.minAreaRect(at)).round().astype(np.int32)
            rectangle = filled_polygon(top.shape, corners)
            self.away.append(ndimage.distance_transform_edt(~self.outlines[-1]) * _CELL_M)
            self.away_from_whole.append(ndimage.distance_transform_edt(~rectangle) * _CELL_M)

    def apart(self, i: int, j: int) -> bool:
        """Tell whether there is an open gap between two tops."""
        one, two = self.outlines[i], self.outlines[j]
        if (one & two).sum() > _MAX_OVERLAP * min(one.sum(), two.sum()):
            return False
        gap = float(self.away[i][two].min())
        if not _GAP_M[0] <= gap <= _GAP_M[1]:
            return gap > _GAP_M[1]
        strip = self.away[i] + self.away[j] < gap + 1.5 * _CELL_M
        strip &= (self.away[i] > _CELL_M) & (self.away[j] > _CELL_M)
        if strip.sum() * _CELL_M**2 < _MIN_STRIP_M * (gap - 2 * _CELL_M):
            return False
        covered = strip & (self.heights > 0.5 * min(self.height[i], self.height[j]))
        return float(covered.sum()) < _MAX_COVERED * strip.sum()

    def nearest(self, groups: list[list[int]]) -> np.ndarray:
        """Return for each vertex of the body the group of tops that is nearest in plan."""
        away = np.stack([np.min([self.away_from_whole[k] for k in group], axis=0) for group in groups])
        return np.argmin(away[:, self.cells[:, 0], self.cells[:, 1]], axis=0)


def _tops(heights: np.ndarray) -> list[np.ndarray]:
    """Return the large regions of cells without steps; narrow bridges between two are cut, small holes closed."""
    seen = heights > 0
    near = ndimage.distance_transform_edt(~seen, return_distances=False, return_indices=True)
    filled = heights[tuple(near)]
    closed = ndimage.binary_closing(seen, np.ones((3, 3)))
    smooth = ndimage.median_filter(filled, 3)
    steps = ndimage.maximum_filter(smooth, 3) - ndimage.minimum_filter(smooth, 3)
    core = ndimage.binary_erosion(closed & (steps < 2 * _STEP_M))
    label, count = ndimage.label(core)
    sizes = np.bincount(label.ravel(), minlength=count + 1) * _CELL_M**2
    return [
        ndimage.binary_dilation(label == k) & closed for k in range(1, count + 1) if sizes[k] >= _MIN_TOP_M2
    ]
