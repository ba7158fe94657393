"""Things that overlap sideways by less than they are known: their collision shapes give way, nothing moves.

Both were seen where they stand, and shapes are off by a centimetre, mostly where no frame looked: between them. Each
of the two convex pieces is cut off at the middle of the overlap.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from reconstruction.assembly.collision import cut
from reconstruction.core.types import ConvexPart
from registry.geometry import transform_points

_STEEPEST = 0.5  # z of a normal that is still sideways
_GAP_M = 2e-4  # left between the two
_MOST_OF_A_PIECE = 0.35  # of its extent that a piece may lose


@dataclass(frozen=True)
class Overlap:
    """How far a piece of one thing is in a piece of another."""

    normal: np.ndarray  # (3,) world, the shortest way out for the first
    low: float  # where along the normal the first piece begins, metres
    high: float  # and where the second one ends
    first_extent: float
    second_extent: float

    @property
    def depth(self) -> float:
        """In metres."""
        return self.high - self.low

    @property
    def sideways(self) -> bool:
        """Tell whether the way out is rather level."""
        return abs(self.normal[2]) < _STEEPEST


def give_way(
    first: tuple[ConvexPart, ...],
    first_pose: np.ndarray,
    second: tuple[ConvexPart, ...],
    second_pose: np.ndarray,
    *,
    tolerance_m: float,
    most_m: float,
    rests_on: bool,
) -> tuple[tuple[ConvexPart, ...], tuple[ConvexPart, ...], float]:
    """Cut the pieces of two things where they overlap sideways.

    Args:
        first: convex pieces, object space.
        first_pose: (4, 4).
        second: of the other thing.
        second_pose: (4, 4).
        tolerance_m: overlap that counts as touching.
        most_m: how much each of the two may lose; what overlaps by more than both give is left as it is.
        rests_on: one carries the other; then only what is shortest to leave sideways counts.

    Returns:
        The pieces of both, and the deepest overlap that was taken away (0: nothing was cut).
    """
    one, other, deepest = list(first), list(second), 0.0
    ours = [in_world(part, first_pose) for part in one]
    theirs = [in_world(part, second_pose) for part in other]
    for i in range(len(one)):
        for j in range(len(other)):
            found = overlap_of(ours[i], theirs[j], sideways_only=not rests_on)
            if found is None or found.depth <= tolerance_m or not found.sideways:
                continue
            middle = _middle(found, most_m)
            if middle is None:
                continue
            kept_one = _behind(one[i], first_pose, found.normal, middle + 0.5 * _GAP_M)
            kept_other = _behind(other[j], second_pose, -found.normal, 0.5 * _GAP_M - middle)
            if kept_one is not None and kept_other is not None:
                one[i], other[j], deepest = kept_one, kept_other, max(deepest, found.depth)
                ours[i], theirs[j] = in_world(kept_one, first_pose), in_world(kept_other, second_pose)
    return (tuple(one), tuple(other), deepest) if deepest > 0 else (first, second, 0.0)


def cut_out(
    first: tuple[ConvexPart, ...],
    first_pose: np.ndarray,
    second: tuple[ConvexPart, ...],
    second_pose: np.ndarray,
    tolerance_m: float,
    clearance_m: float = 0.0,
) -> tuple[tuple[ConvexPart, ...], float]:
    """Cut off all of the first thing's pieces that is in the second one: (what is left, the deepest overlap).

    With a clearance pieces that are nearer to each other than that are in each other, too, by how much nearer they are.
    """
    theirs = [in_world(part, second_pose) for part in second]
    left, deepest = [], 0.0
    for part in first:
        kept: ConvexPart | None = part
        for their in theirs:
            found = overlap_of(
                in_world(kept, first_pose), their, sideways_only=False, clearance_m=clearance_m
            )
            if found is None or found.depth <= tolerance_m:
                continue
            deepest = max(deepest, found.depth)
            kept = _behind(kept, first_pose, found.normal, found.high + _GAP_M)
            if kept is None:
                break
        left += [] if kept is None else [kept]
    return tuple(left), deepest


def overlap_of(
    first: tuple[np.ndarray, np.ndarray],
    second: tuple[np.ndarray, np.ndarray],
    *,
    sideways_only: bool,
    clearance_m: float = 0.0,
) -> Overlap | None:
    """Return how two convex pieces overlap, None where they do not: separating axes over the normals of their faces.

    Args:
        first: (v, 3) corners and (f, 3) outward normals of its faces, world space.
        second: of the other one.
        sideways_only: the way out must be rather level.
        clearance_m: the second one is thicker by this on all sides.
    """
    (a, a_normals), (b, b_normals) = first, second
    if np.any(a.min(axis=0) > b.max(axis=0) + clearance_m):
        return None
    if np.any(a.max(axis=0) < b.min(axis=0) - clearance_m):
        return None
    ways = np.concatenate([-a_normals, b_normals])  # directions in which the first one may leave
    along_a, along_b = a @ ways.T, b @ ways.T
    depth = along_b.max(axis=0) + clearance_m - along_a.min(axis=0)
    if depth.min() <= 0:
        return None
    if sideways_only:
        depth = np.where(np.abs(ways[:, 2]) < _STEEPEST, depth, np.inf)
    k = int(np.argmin(depth))
    if not np.isfinite(depth[k]):
        return None
    low, high = float(along_a[:, k].min()), float(along_b[:, k].max()) + clearance_m
    return Overlap(ways[k], low, high, float(np.ptp(along_a[:, k])), float(np.ptp(along_b[:, k])))


def _middle(found: Overlap, most_m: float) -> float | None:
    """Return where along the normal the two shall meet, None where they cannot give enough."""
    most_first = min(most_m, _MOST_OF_A_PIECE * found.first_extent)
    most_second = min(most_m, _MOST_OF_A_PIECE * found.second_extent)
    if found.depth > most_first + most_second:
        return None
    of_first = min(max(0.5 * found.depth, found.depth - most_second), most_first)
    return found.low + of_first


def _behind(part: ConvexPart, pose: np.ndarray, normal: np.ndarray, level: float) -> ConvexPart | None:
    """Keep what lies at normal . x >= level (world) of a piece."""
    made = cut((part,), pose[:3, :3].T @ normal, float(normal @ pose[:3, 3]) - level)
    return made[0] if made else None


def in_world(part: ConvexPart, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    vertices, faces = np.asarray(part.vertices, np.float32), np.asarray(part.faces, np.int32)
    return transform_points(pose, vertices), _face_normals(vertices.tobytes(), faces.tobytes()) @ pose[
        :3, :3
    ].T


@lru_cache(maxsize=4096)
def _face_normals(vertices: bytes, faces: bytes) -> np.ndarray:
    """Return the outward normals (n, 3) of a piece's faces, each direction once."""
    corners = np.frombuffer(vertices, np.float32).reshape(-1, 3).astype(np.float64)
    a, b, c = (corners[np.frombuffer(faces, np.int32).reshape(-1, 3)[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    length = np.linalg.norm(normals, axis=1)
    normals = normals[length > 1e-12] / length[length > 1e-12, None]
    outward = np.einsum("ij,ij->i", normals, a[length > 1e-12] - corners.mean(axis=0)) >= 0
    normals = np.where(outward[:, None], normals, -normals)
    return normals[np.unique(normals.round(3), axis=0, return_index=True)[1]]
