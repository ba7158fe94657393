"""Support relations between objects, from the surface around the foot of each."""

import numpy as np
from scipy.spatial import ConvexHull, QhullError, cKDTree  # pyright: ignore[reportAttributeAccessIssue]

from reconstruction.core.mesh_graph import MeshGraph

# Distances from the foot in plan, of which the second counts where the first finds no support.
NEAR_REACH_M, _FAR_REACH_M = 0.05, 0.3
_RISE_M, _DROP_M = 0.03, 0.06  # the support's surface may lie this far above and below the foot
UP = 0.5  # least z of the normals of a support surface
_ON_FLOOR_M = 0.05  # a foot below this height stands on the floor
# An object that hides the whole top of its support: the support ends near the foot, and their footprints overlap.
_TOP_BELOW_M, _TOP_ABOVE_M = 0.03, 0.02  # the support's top may lie this far below and above the foot
_COMMON_PLAN, _PLAN_STEPS = 0.5, 24  # overlap over the smaller footprint; grid points a side that measure it


def carriers(
    graph: MeshGraph, things: list[np.ndarray], reaches: tuple[float, ...] = (NEAR_REACH_M, _FAR_REACH_M)
) -> list[int]:
    """Return the row of the object that supports each object, -1 for none (it stands on the floor, or hangs).

    The support is the object with the most up-facing area around and below the foot, whose own foot is lower. An object
    that ends right below the foot replaces it if it is in between: a plate hides the top of the box under it, while
    the table around both is visible. Support has no cycles.

    Args:
        graph: the surface.
        things: int (n,) vertices of each object.
        reaches: distances from the foot in plan, metres, to search for a support, one after another.
    """
    bottoms = [bottom_of(graph.points[v]) for v in things]
    owner = np.full(len(graph.points), -1, np.int64)
    for row, vertices in enumerate(things):
        owner[vertices] = row
    up = np.flatnonzero((owner >= 0) & (graph.normals[:, 2] > UP))
    tree = cKDTree(graph.points[up]) if len(up) else None
    out = [-1] * len(things)
    for row in sorted(range(len(things)), key=lambda r: (bottoms[r], -len(things[r]))):
        if tree is None or bottoms[row] < _ON_FLOOR_M:
            continue
        barred = [
            other == row or bottoms[other] > bottoms[row] - 0.002 or _stands_on(out, other, row)
            for other in range(len(things))
        ]
        for reach in reaches:  # the support's surface may have a hole around the foot
            area = _area_below(graph, things[row], bottoms[row], tree, up, owner, len(things), reach)
            area[barred] = 0.0
            if area.max(initial=0.0) > 0:
                out[row] = int(np.argmax(area))
                break
        hidden = _hidden_carrier(graph, things, row, bottoms, barred)
        if hidden >= 0 and (
            out[row] < 0 or (bottoms[hidden] > bottoms[out[row]] and _stands_on(out, hidden, out[row]))
        ):
            out[row] = hidden
    return out


def _hidden_carrier(
    graph: MeshGraph, things: list[np.ndarray], row: int, bottoms: list[float], barred: list[bool]
) -> int:
    """Return the object that ends right below the foot of `row` and whose footprint overlaps most, or -1."""
    best, most = -1, _COMMON_PLAN
    for other, vertices in enumerate(things):
        if barred[other] or len(vertices) < 3:
            continue
        top = float(np.percentile(graph.points[vertices, 2], 98)) - bottoms[row]
        if -_TOP_BELOW_M < top < _TOP_ABOVE_M:
            common = _common_plan(graph.points[things[row], :2], graph.points[vertices, :2])
            if common > most:
                best, most = other, common
    return best


def _common_plan(first: np.ndarray, second: np.ndarray) -> float:
    """Return the overlap of the convex hulls of points (n, 2) and (m, 2), as a share of the smaller hull's area."""
    low, high = np.maximum(first.min(0), second.min(0)), np.minimum(first.max(0), second.max(0))
    if (low >= high).any():
        return 0.0
    try:
        hulls = [ConvexHull(points) for points in (first, second)]
    except QhullError:
        return 0.0
    axes = [np.linspace(low[k], high[k], _PLAN_STEPS) for k in range(2)]
    grid = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    inside = np.ones(len(grid), bool)
    for hull in hulls:
        inside &= (grid @ hull.equations[:, :2].T + hull.equations[:, 2] <= 1e-9).all(axis=1)
    return float(inside.mean() * np.prod(high - low) / max(min(hull.volume for hull in hulls), 1e-9))


def _stands_on(carrier: list[int], upper: int, lower: int) -> bool:
    while upper >= 0:
        if upper == lower:
            return True
        upper = carrier[upper]
    return False


def foot_of(points: np.ndarray, bottom: float) -> np.ndarray:
    """Return up to about 400 points (k, 3) of the lowest band of an object's points (n, 3), at its bottom's height."""
    foot = points[points[:, 2] < bottom + max(0.02, 0.15 * np.ptp(points[:, 2]))].copy()
    foot[:, 2] = bottom
    return foot[:: max(1, len(foot) // 400)]


def bottom_of(points: np.ndarray) -> float:
    """Return the height of an object's foot, without its lowest points (n, 3), which are noise."""
    return float(np.percentile(points[:, 2], 2))


def carrying(points: np.ndarray, bottom: float) -> np.ndarray:
    """Return which points (n, 3) are at the height, bool (n,), of a support of an object that ends at `bottom`."""
    height = points[:, 2] - bottom
    return (height < _RISE_M) & (height > -_DROP_M)


def _area_below(
    graph: MeshGraph, vertices: np.ndarray, bottom: float, tree: cKDTree, up: np.ndarray, owner: np.ndarray, count: int,
    reach: float,
) -> np.ndarray:  # fmt: skip
    """Return the up-facing area (count,) of each object around and just below the foot, less with distance in plan."""
    foot = foot_of(graph.points[vertices], bottom)
    radius = np.hypot(reach, max(_RISE_M, _DROP_M))
    found = np.unique(np.concatenate([np.asarray(x, np.int64) for x in tree.query_ball_point(foot, radius)]))
    near = up[found.astype(np.int64)]
    near = near[carrying(graph.points[near], bottom)]
    gap = cKDTree(foot[:, :2]).query(graph.points[near, :2])[0]
    weight = graph.areas[near] * np.clip(1.0 - gap / reach, 0.0, 1.0)
    return np.bincount(owner[near], weights=weight, minlength=count)
