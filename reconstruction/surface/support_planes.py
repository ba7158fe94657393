"""Detect support planes: level surfaces with free space above, such as table tops, shelf boards, seats and lids."""

import cv2
import numpy as np
from scipy.ndimage import binary_fill_holes
from scipy.ndimage import label as connected_cells
from scipy.spatial import KDTree

from reconstruction.core.mesh_graph import MeshGraph
from reconstruction.core.types import Plane, SpaceGrid, SurfacePlane
from reconstruction.surface.base_planes import FittedPlane, base_outline, on_plane, plane_axes
from reconstruction.surface.levels import horizontal_levels, joined_levels

_STEP_M = 0.012  # largest height difference of patches of one plane
_ADJACENT_M = 0.06  # horizontal gap below which two patches are joined
_HIDDEN_M = 0.25  # the same for patches of similar color with an occluded gap
_ALIKE_LAB = 25.0  # largest CIELAB difference of similar colors
_MAX_TILT_DEG = 5.0
_OVER_FLOOR_M = 0.03  # lower surfaces are floor: rugs and noise
_ABOVE_M = (0.04, 0.07, 0.10)  # heights above a surface where free space is tested, beyond the carving margin
_BAY_M = 0.06  # half the width below which concavities of an outline are filled


def find_support_planes(
    graph: MeshGraph, free: np.ndarray, floor: FittedPlane | None, space: SpaceGrid, min_area_m2: float
) -> list[SurfacePlane]:
    """Detect the support planes among vertices `free` (sorted indices, those on no base plane), lowest first."""
    groups = _joined(graph, horizontal_levels(graph, free, 0.1 * min_area_m2), space)
    groups.sort(key=lambda group: (-graph.areas[group].sum(), group[0]))
    left = np.zeros(len(graph.points), bool)
    left[free] = True
    found = []
    for group in groups:
        group = group[left[group]]
        if graph.areas[group].sum() < min_area_m2:
            break
        plane = _fit_level(graph, group)
        if plane is None:
            continue
        if floor is not None and float(np.median(floor.distance(graph.points[group]))) < _OVER_FLOOR_M:
            continue
        members, band = _members(graph, left, group, plane)
        if graph.areas[members].sum() < min_area_m2 or not _free_above(graph, members, space):
            continue
        left[members] = False
        outline = _outline(graph.points[members], plane, graph.spacing_m)
        area = float(graph.areas[members].sum())
        found.append(SurfacePlane("support", Plane(plane, outline), area, band, members.astype(np.int32)))
    return sorted(
        found, key=lambda support: (float(support.surface.polygon[:, 2].mean()), support.vertices[0])
    )


def _joined(graph: MeshGraph, levels: list[np.ndarray], space: SpaceGrid) -> list[np.ndarray]:
    """Join patches of one height that touch, or that have similar colors and an occluded gap between them."""
    points = [graph.points[level] for level in levels]
    height = [float(np.median(p[:, 2])) for p in points]
    boxes = [(p[:, :2].min(axis=0), p[:, :2].max(axis=0)) for p in points]
    colors = [np.median(graph.lab[level], axis=0) for level in levels]

    def of_one(i: int, j: int) -> bool:
        if abs(height[i] - height[j]) > _STEP_M:
            return False
        if np.maximum(boxes[i][0] - boxes[j][1], boxes[j][0] - boxes[i][1]).max() > _HIDDEN_M:
            return False
        gap, nearest = KDTree(points[i][:, :2]).query(points[j][:, :2], distance_upper_bound=_HIDDEN_M)
        gap, nearest = np.asarray(gap), np.asarray(nearest)
        k = int(np.argmin(gap))
        if gap[k] < _ADJACENT_M or not np.isfinite(gap[k]):
            return bool(gap[k] < _ADJACENT_M)
        if np.abs(colors[i] - colors[j]).max() > _ALIKE_LAB:
            return False
        # Free space below their height in the gap separates them.
        line = points[j][k] + np.linspace(0, 1, 12)[1:-1, None] * (points[i][nearest[k]] - points[j][k])
        return bool((space.lookup(line - [0, 0, space.voxel_size_m]) == 1).mean() < 0.3)

    return joined_levels(levels, of_one)


def _fit_level(graph: MeshGraph, group: np.ndarray) -> np.ndarray | None:
    """Fit a plane (4,) to a group of vertices by trimmed least squares; None if it is not level."""
    points, areas = graph.points[group], graph.areas[group]
    center = np.array([*np.average(points[:, :2], axis=0, weights=areas), np.median(points[:, 2])])
    local = points - center
    slope, height = np.zeros(2), 0.0
    for _ in range(3):
        near = np.abs(local[:, 2] - local[:, :2] @ slope - height) < _STEP_M
        weights = np.sqrt(areas[near])[:, None]
        design = np.column_stack([local[near, :2], np.ones(near.sum())]) * weights
        solution = np.linalg.lstsq(design, local[near, 2] * weights[:, 0], rcond=None)[0]
        slope, height = solution[:2], float(solution[2])
        if np.linalg.norm(slope) > np.tan(np.radians(_MAX_TILT_DEG)):
            return None
    normal = np.array([-slope[0], -slope[1], 1.0]) / np.sqrt(1.0 + slope @ slope)
    center[2] += height
    return np.append(normal, -normal @ center)


def _members(
    graph: MeshGraph, left: np.ndarray, group: np.ndarray, plane: np.ndarray
) -> tuple[np.ndarray, float]:
    """Return the vertices on the plane near a group, including those with noisy normals, and the band width."""
    residual = np.abs(graph.points[group] @ plane[:3] + plane[3])
    band = float(np.clip(3.0 * 1.4826 * np.median(residual), 0.004, _STEP_M))
    low, high = graph.points[group].min(axis=0) - _ADJACENT_M, graph.points[group].max(axis=0) + _ADJACENT_M
    near = left & ((graph.points > low) & (graph.points < high)).all(axis=1) & (graph.normals[:, 2] > 0.5)
    level = np.flatnonzero(near)
    level = level[np.abs(graph.points[level] @ plane[:3] + plane[3]) < band]
    reach = max(0.03, 2.0 * graph.spacing_m)
    gap, _ = KDTree(graph.points[group]).query(graph.points[level], distance_upper_bound=reach)
    return level[np.isfinite(gap)], band


def _free_above(graph: MeshGraph, members: np.ndarray, space: SpaceGrid) -> bool:
    """Tell whether the space above most of the surface is free."""
    seen = np.zeros(len(members), bool)
    for lift in _ABOVE_M:
        seen |= space.lookup(graph.points[members] + [0, 0, lift]) == 1
    return bool(graph.areas[members][seen].sum() > 0.5 * graph.areas[members].sum())


def _outline(points: np.ndarray, plane: np.ndarray, spacing_m: float) -> np.ndarray:
    """Return the outline (k, 3) of points on a plane: the convex hull of a nearly convex shape, else a contour."""
    axes = np.stack(plane_axes(plane), axis=1)
    uv = points @ axes
    cell = max(0.01, spacing_m)
    radius = max(2, round(_BAY_M / cell))
    origin = uv.min(axis=0) - (radius + 1) * cell
    cells = np.floor((uv - origin) / cell).astype(np.int32)
    grid = np.zeros(cells.max(axis=0) + radius + 2, np.uint8)
    grid[cells[:, 0], cells[:, 1]] = 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1,) * 2)
    filled = np.asarray(binary_fill_holes(cv2.morphologyEx(grid, cv2.MORPH_CLOSE, disc) > 0))
    hull = np.zeros_like(grid)
    cv2.fillConvexPoly(hull, cv2.convexHull(np.ascontiguousarray(cells[:, ::-1])), 1)
    if filled.sum() > 0.85 * hull.sum() or connected_cells(filled)[1] > 1:  # pyright: ignore[reportIndexIssue]
        return base_outline(points, plane)
    contours, _ = cv2.findContours(filled.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    contour = cv2.approxPolyDP(max(contours, key=cv2.contourArea), 1.0, True).reshape(-1, 2)[:, ::-1]
    return on_plane(origin + (contour + 0.5) * cell, plane)
