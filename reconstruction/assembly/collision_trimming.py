"""Cut collision shapes of objects that overlap, by separating axes between convex parts.

Where objects overlap sideways by less than the accuracy of reconstruction, both keep their poses: shapes are off by a
centimetre, mostly between objects, where no frame looked. Both parts are cut at the middle of the overlap.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from reconstruction.assembly.collision import cut
from reconstruction.core.types import ConvexPart
from registry.geometry import transform_points

_STEEPEST = 0.5  # largest z of a sideways normal
_GAP_M = 2e-4  # left between the two parts
_MOST_OF_A_PART = 0.35  # of its extent along the normal that a part may lose


@dataclass(frozen=True)
class Overlap:
    """The overlap of two convex parts along the axis of least penetration."""

    normal: np.ndarray  # (3,) world, direction in which the first part leaves the second
    low: float  # lower end of the first part along the normal, metres
    high: float  # upper end of the second part
    first_extent: float  # along the normal
    second_extent: float

    @property
    def depth(self) -> float:
        """Return the penetration depth, metres."""
        return self.high - self.low

    @property
    def sideways(self) -> bool:
        """Tell whether the normal is rather horizontal."""
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
    """Cut the parts of two objects where they overlap sideways.

    Args:
        first: convex parts, object space.
        first_pose: world_from_object (4, 4).
        second: parts of the other object.
        second_pose: world_from_object (4, 4).
        tolerance_m: depth that counts as contact.
        most_m: largest depth that each of two parts may lose; deeper overlaps are left.
        rests_on: one object supports the other: only parts whose axis of least penetration is sideways are cut. Else
            that axis is chosen among the sideways ones.

    Returns:
        The parts of both, and the largest depth that was removed (0: nothing was cut).
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
    *,
    sideways: bool = False,
) -> tuple[tuple[ConvexPart, ...], float]:
    """Cut the first object's parts where they overlap the second's; arguments as in `give_way`.

    With `sideways` only parts whose axis of least penetration is rather horizontal are cut.

    Returns:
        The parts left, and the largest depth; with a clearance, parts nearer than that overlap too.
    """
    theirs = [in_world(part, second_pose) for part in second]
    left, deepest = [], 0.0
    for part in first:
        kept: ConvexPart | None = part
        for their in theirs:
            our = in_world(kept, first_pose)
            found = overlap_of(our, their, sideways_only=False, clearance_m=clearance_m)
            if found is None or found.depth <= tolerance_m or (sideways and not found.sideways):
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
    """Return the overlap of two convex parts by the separating axis test over their face normals; None if apart.

    Args:
        first: vertices (v, 3) and outward face normals (f, 3) in world space, from `in_world`.
        second: those of the other part.
        sideways_only: only use axes that are rather horizontal.
        clearance_m: the second part is dilated by this.
    """
    (a, a_normals), (b, b_normals) = first, second
    if np.any(a.min(axis=0) > b.max(axis=0) + clearance_m):
        return None
    if np.any(a.max(axis=0) < b.min(axis=0) - clearance_m):
        return None
    axes = np.concatenate([-a_normals, b_normals])  # directions in which the first part may leave
    along_a, along_b = a @ axes.T, b @ axes.T
    depth = along_b.max(axis=0) + clearance_m - along_a.min(axis=0)
    if depth.min() <= 0:
        return None
    if sideways_only:
        depth = np.where(np.abs(axes[:, 2]) < _STEEPEST, depth, np.inf)
    k = int(np.argmin(depth))
    if not np.isfinite(depth[k]):
        return None
    low, high = float(along_a[:, k].min()), float(along_b[:, k].max()) + clearance_m
    return Overlap(axes[k], low, high, float(np.ptp(along_a[:, k])), float(np.ptp(along_b[:, k])))


def _middle(found: Overlap, most_m: float) -> float | None:
    """Return the position along the normal at which to cut both parts; None if the overlap is too deep."""
    most_first = min(most_m, _MOST_OF_A_PART * found.first_extent)
    most_second = min(most_m, _MOST_OF_A_PART * found.second_extent)
    if found.depth > most_first + most_second:
        return None
    of_first = min(max(0.5 * found.depth, found.depth - most_second), most_first)
    return found.low + of_first


def _behind(part: ConvexPart, pose: np.ndarray, normal: np.ndarray, level: float) -> ConvexPart | None:
    """Clip a part to normal . x >= level, in world space; None if nothing is left."""
    made = cut((part,), pose[:3, :3].T @ normal, float(normal @ pose[:3, 3]) - level)
    return made[0] if made else None


def in_world(part: ConvexPart, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the vertices (v, 3) and distinct outward face normals (n, 3) of a part in world space."""
    vertices, faces = np.asarray(part.vertices, np.float32), np.asarray(part.faces, np.int32)
    normals = _face_normals(vertices.tobytes(), faces.tobytes())
    return transform_points(pose, vertices), normals @ pose[:3, :3].T


@lru_cache(maxsize=4096)
def _face_normals(vertices: bytes, faces: bytes) -> np.ndarray:
    """Return the outward face normals (n, 3) of a part, each direction once."""
    corners = np.frombuffer(vertices, np.float32).reshape(-1, 3).astype(np.float64)
    a, b, c = (corners[np.frombuffer(faces, np.int32).reshape(-1, 3)[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    length = np.linalg.norm(normals, axis=1)
    normals = normals[length > 1e-12] / length[length > 1e-12, None]
    outward = np.einsum("ij,ij->i", normals, a[length > 1e-12] - corners.mean(axis=0)) >= 0
    normals = np.where(outward[:, None], normals, -normals)
    return normals[np.unique(normals.round(3), axis=0, return_index=True)[1]]
