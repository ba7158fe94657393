"""What makes a true object easy or hard to find: its size, what it stands on, how near its neighbor is."""

from dataclasses import dataclass

import numpy as np

from reconstruction.measure.ground_truth import GroundTruth, TrueEntity
from reconstruction.measure.surfaces import sample

SUPPORTS = ("floor", "furniture", "thing", "wall")
_SAMPLES = 10_000
_NEIGHBORS_REFINED = 3
_STEPS = 60
_CONVERGED_M = 1e-6


@dataclass(frozen=True)
class ObjectFacts:
    """Facts of one true object; they depend on the truth alone."""

    longest_side_m: float  # of its smallest upright box
    support: str  # of SUPPORTS, see `support_of`
    gap_m: float  # between its surface and the nearest other thing's; inf where there is none
    neighbor: int | None  # that thing's id


def object_facts(truth: GroundTruth) -> dict[int, ObjectFacts]:
    """Return the facts of every object of a truth by id, whether it is seen well enough to be evaluated or not."""
    things = [e for e in truth.entities if not e.base]
    by_id = {e.id: e for e in truth.entities}
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


def support_of(entity: TrueEntity, by_id: dict[int, TrueEntity]) -> str:
    """Say what an object is on.

    "wall": it is attached to something. "floor": it stands there. "furniture": it stands on what stands on the floor or
    hangs on a wall. "thing": it stands on anything else, such as a plate on a table.
    """
    if entity.relation == "attached_to":
        return "wall"
    parent = by_id.get(entity.parent)
    if parent is None or parent.base:
        return "floor"
    grandparent = by_id.get(parent.parent)
    on_base = grandparent is None or grandparent.base
    return "furniture" if on_base or parent.relation == "attached_to" else "thing"


def _gaps(things: list[TrueEntity], by_id: dict[int, TrueEntity]) -> dict[int, tuple[float, int | None]]:
    """Return by id the distance to the nearest thing that neither carries the object nor is carried by it."""
    from scipy.spatial import cKDTree

    triangles = {e.id: np.asarray(e.mesh.triangles, np.float64) for e in things}
    points = {
        e.id: np.concatenate([sample(e.mesh.vertices, e.mesh.faces, _SAMPLES).points, e.mesh.vertices])
        for e in things
    }
    trees = {i: cKDTree(p) for i, p in points.items()}
    carriers = {e.id: _carriers(e, by_id) for e in things}
    out: dict[int, tuple[float, int | None]] = {}
    for a in things:
        others = [
            b for b in things if b is not a and b.id not in carriers[a.id] and a.id not in carriers[b.id]
        ]
        near: list[tuple[float, int, np.ndarray, np.ndarray]] = []
        for b in sorted(others, key=lambda b: _box_distance(a, b)):
            if len(near) >= _NEIGHBORS_REFINED and _box_distance(a, b) > near[0][0]:
                break  # this one and all after it are farther than what was found
            distance, nearest = trees[b.id].query(points[a.id])
            at = int(np.argmin(distance))
            near.append((float(distance[at]), b.id, points[a.id][at], points[b.id][nearest[at]]))
            near.sort(key=lambda item: item[:2])
        exact = [
            (_approach(triangles[a.id], triangles[i], p, q), i) for _, i, p, q in near[:_NEIGHBORS_REFINED]
        ]
        out[a.id] = min(exact, default=(float("inf"), None))
    return out


def _box_distance(a: TrueEntity, b: TrueEntity) -> float:
    """Return the distance between the axis-aligned boxes of two things, which theirs cannot be below."""
    (low_a, high_a), (low_b, high_b) = a.mesh.bounds, b.mesh.bounds
    return float(np.linalg.norm(np.maximum(0.0, np.maximum(low_a - high_b, low_b - high_a))))


def _carriers(entity: TrueEntity, by_id: dict[int, TrueEntity]) -> set[int]:
    """Return all that the object stands on or hangs from, down to the base."""
    out: set[int] = set()
    parent = entity.parent
    while parent in by_id and parent not in out:
        out.add(parent)
        parent = by_id[parent].parent
    return out


def _approach(a: np.ndarray, b: np.ndarray, p: np.ndarray, q: np.ndarray) -> float:
    """Return the distance between triangles (n, 3, 3) and (m, 3, 3), found by stepping from a near pair of points."""
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
    """Return the point (3,) of triangles (n, 3, 3) that is nearest to a point (3,)."""
    from trimesh.triangles import closest_point

    near = closest_point(triangles, np.broadcast_to(point, (len(triangles), 3)))
    return near[np.argmin(((near - point) ** 2).sum(axis=1))]
