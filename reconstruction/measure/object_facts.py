"""Facts of true objects for breakdowns of recall: size, support, distance to the nearest neighbor."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from reconstruction.measure.ground_truth import GroundTruth, TrueEntity
from reconstruction.measure.surfaces import sample

SUPPORTS = ("floor", "furniture", "thing", "wall")
_SAMPLES = 10_000  # points per object for approximate distances
_BOUNDING = 50  # points whose distance bounds that of all
_NEIGHBORS_REFINED = 3  # nearest neighbors by samples whose exact distance is computed
_STEPS, _CONVERGED_M = 60, 1e-6  # limits of the alternating projection


@dataclass(frozen=True)
class ObjectFacts:
    """Facts of one true object, from the truth alone."""

    longest_side_m: float  # of its smallest upright bounding box
    support: str  # of SUPPORTS, see `support_of`
    gap_m: float  # distance between its surface and the nearest other object's; inf without one
    neighbor: int | None  # id of that object


def object_facts(truth: GroundTruth) -> dict[int, ObjectFacts]:
    """Compute the facts of all true objects by id, evaluated or not."""
    things = [e for e in truth.entities if not e.base]
    by_id: dict[int | None, TrueEntity] = {e.id: e for e in truth.entities}
    gaps = _gaps(things, by_id)
    return {
        e.id: ObjectFacts(longest_side(np.asarray(e.mesh.vertices)), support_of(e, by_id), *gaps[e.id])
        for e in things
    }


def longest_side(vertices: np.ndarray) -> float:
    """Return the longest side of the smallest box with vertical sides around vertices (n, 3)."""
    import cv2

    _, sides, _ = cv2.minAreaRect(cv2.convexHull(np.ascontiguousarray(vertices[:, :2], np.float32)))
    return float(max(*sides, np.ptp(vertices[:, 2])))


def support_of(entity: TrueEntity, by_id: dict[int | None, TrueEntity]) -> str:
    """Classify the support of an object as one of SUPPORTS.

    "wall": attached to anything. "floor": on the base. "furniture": on an object that is on the base or attached.
    "thing": on any other object, such as a plate on a table.
    """
    if entity.relation == "attached_to":
        return "wall"
    parent = by_id.get(entity.parent)
    if parent is None or parent.base:
        return "floor"
    grandparent = by_id.get(parent.parent)
    on_base = grandparent is None or grandparent.base
    return "furniture" if on_base or parent.relation == "attached_to" else "thing"


def _gaps(
    things: list[TrueEntity], by_id: dict[int | None, TrueEntity]
) -> dict[int, tuple[float, int | None]]:
    """Return per id the distance to, and id of, the nearest object that is not connected to it by support."""
    triangles = {e.id: np.asarray(e.mesh.triangles, np.float64) for e in things}
    points = {
        e.id: np.concatenate([sample(e.mesh.vertices, e.mesh.faces, _SAMPLES).points, e.mesh.vertices])
        for e in things
    }
    trees = {i: KDTree(p) for i, p in points.items()}
    supports = {e.id: _ancestors(e, by_id) for e in things}
    out: dict[int, tuple[float, int | None]] = {}
    for a in things:
        others = [
            b for b in things if b is not a and b.id not in supports[a.id] and a.id not in supports[b.id]
        ]
        near: list[tuple[float, int, np.ndarray, np.ndarray]] = []
        for b in sorted(others, key=lambda b: _box_distance(a, b)):
            if len(near) >= _NEIGHBORS_REFINED and _box_distance(a, b) > near[0][0]:
                break  # the lower bound of this and all later ones exceeds the smallest distance found
            distance, p, q = _closest_pair(points[a.id], trees[b.id])
            near.append((distance, b.id, p, q))
            near.sort(key=lambda item: item[:2])
        exact = [
            (_surface_distance(triangles[a.id], triangles[i], p, q), i)
            for _, i, p, q in near[:_NEIGHBORS_REFINED]
        ]
        out[a.id] = min(exact, default=(float("inf"), None))
    return out


def _closest_pair(points: np.ndarray, tree: KDTree) -> tuple[float, np.ndarray, np.ndarray]:
    """Return the smallest distance between points (n, 3) and those of a tree, and its two points (3,)."""
    # The distance of a few points bounds the search of all: most of them are farther away and cost little.
    bound = float(np.min(tree.query(points[:: 1 + len(points) // _BOUNDING])[0]))
    distance, nearest = tree.query(points, distance_upper_bound=np.nextafter(bound, np.inf))
    at = int(np.argmin(distance))
    return float(distance[at]), points[at], np.asarray(tree.data)[np.asarray(nearest)[at]]


def _box_distance(a: TrueEntity, b: TrueEntity) -> float:
    """Return the distance between two axis-aligned bounding boxes, a lower bound of the surface distance."""
    (low_a, high_a), (low_b, high_b) = a.bounds, b.bounds
    return float(np.linalg.norm(np.maximum(0.0, np.maximum(low_a - high_b, low_b - high_a))))


def _ancestors(entity: TrueEntity, by_id: dict[int | None, TrueEntity]) -> set[int]:
    """Return the ids of the object's ancestors in the scene graph."""
    out: set[int] = set()
    parent = entity.parent
    while parent is not None and parent in by_id and parent not in out:
        out.add(parent)
        parent = by_id[parent].parent
    return out


def _surface_distance(a: np.ndarray, b: np.ndarray, p: np.ndarray, q: np.ndarray) -> float:
    """Minimize the distance of triangles (n, 3, 3) and (m, 3, 3) by alternating projection from points p, q (3,)."""
    before = float(np.linalg.norm(p - q))
    for _ in range(_STEPS):
        q = _closest_point(b, p)
        p = _closest_point(a, q)
        distance = float(np.linalg.norm(p - q))
        if before - distance < _CONVERGED_M:
            return distance
        before = distance
    return before


def _closest_point(triangles: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Return the closest point (3,) on triangles (n, 3, 3) to a point (3,)."""
    from trimesh.triangles import closest_point

    near = closest_point(triangles, np.broadcast_to(point, (len(triangles), 3)))
    return near[np.argmin(((near - point) ** 2).sum(axis=1))]
