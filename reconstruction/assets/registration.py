"""Registration of a generated mesh of unknown scale, heading and position to the seen points of an object.

Mesh and points are upright. Candidate poses combine headings all around, scales from the seen height and widths, and
positions at which the seen part may lie within the mesh. The best ones are refined by robust symmetric ICP. The result
is the pose that explains most of the seen points with the least surface in free space.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]

_HEADINGS = 24
_SAME_SCALE = 0.04  # log scales closer than this count as one candidate
_SLACK = 0.1  # of the mesh's width: if more of it is unseen, the seen part may lie at either end
_TRIED, _REFINED, _FINISHED = 240, 12, 3  # seen points per candidate; candidates in coarse and in fine ICP
_POINTS = (500, 2500)  # of either side in coarse and fine ICP
_STEPS = (12, 25)
_TRIMMED = 0.92  # quantile of the pairs' distances that is kept
_FACING = 0.3  # least cosine between the normals of a pair
_DAMPING = 1e-5
_SIDEWAYS = 0.15  # weight of a pair's tangential distance
_NEAR_M, _NEAR_SHARE = 0.01, 0.03  # tolerance: the larger of this and this share of the object's size
FreeDepth = Callable[
    [np.ndarray], np.ndarray
]  # points (n, 3) -> depth in free space (n,), metres; 0 outside of it


@dataclass(frozen=True)
class SeenSurface:
    """The seen points of an object, upright, in metres."""

    points: np.ndarray  # float64 (k, 3)
    normals: np.ndarray  # float64 (k, 3) outwards, zero where unknown
    floor_z: float | None  # height of its support; None where unknown

    @property
    def box(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the corners (3,) of the points' box without outliers, down to the support."""
        low, high = np.percentile(self.points, 0.5, axis=0), np.percentile(self.points, 99.5, axis=0)
        if self.floor_z is not None:
            low[2] = self.floor_z
        return low, high


@dataclass(frozen=True)
class Pose:
    """An upright similarity: x -> scale * Rz(heading) @ x + place, about the mesh's bottom center."""

    heading: float
    scale: float
    place: np.ndarray  # float64 (3,)

    @property
    def rotation(self) -> np.ndarray:
        """Return the rotation (3, 3)."""
        c, s = np.cos(self.heading), np.sin(self.heading)
        return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])

    def apply(self, points: np.ndarray) -> np.ndarray:
        """Transform points (n, 3) of the mesh to the seen frame."""
        return self.scale * points @ self.rotation.T + self.place

    def undo(self, points: np.ndarray) -> np.ndarray:
        """Transform points (n, 3) of the seen frame to the mesh."""
        return (points - self.place) @ self.rotation / self.scale


@dataclass(frozen=True)
class Registration:
    """The best pose of a mesh and its residuals."""

    scale: float
    rotation: np.ndarray  # float64 (3, 3) about z
    translation: np.ndarray  # float64 (3,): seen = scale * rotation @ mesh + translation
    distance_m: float  # median distance of the seen points to the mesh
    near_m: float  # tolerance
    missed: float  # share of the seen points beyond the tolerance
    intruding: float  # share of the mesh's surface deeper than that in free space or below the support

    def fault(self, missed: float, intruding: float) -> str:
        """Return why the mesh is rejected at these limits; "" where it is not."""
        if self.missed > missed:
            return (
                f"{self.missed:.0%} of what was seen is farther than {100 * self.near_m:.1f} cm from it "
                f"(at most {missed:.0%} may be)"
            )
        if self.intruding > intruding:
            return f"{self.intruding:.0%} of its surface lies where rays passed through (at most {intruding:.0%} may)"
        return ""


def register(
    points: np.ndarray, normals: np.ndarray, seen: SeenSurface, free_depth: FreeDepth
) -> Registration:
    """Fit an upright mesh to seen points.

    Args:
        points: float (n, 3) evenly on the mesh's surface, +z up, in any unit.
        normals: float (n, 3) outwards.
        seen: the object, some dozens of points at least.
        free_depth: depth of points in free space.

    Returns:
        The best fit, however bad: see `Registration.fault`.
    """
    search = _Search(points, normals, seen, free_depth)
    poses = search.candidates()
    for count, steps, kept in zip(_POINTS, _STEPS, (_FINISHED, 1)):
        poses = search.best([search.refine(pose, count, steps) for pose in poses], kept, count)
    return search.registration(poses[0])


class _Search:
    """Search for the pose of one mesh on one seen surface."""

    def __init__(
        self, points: np.ndarray, normals: np.ndarray, seen: SeenSurface, free_depth: FreeDepth
    ) -> None:
        low, high = points.min(axis=0), points.max(axis=0)
        self.base = np.array([*(low + high)[:2] / 2, low[2]])
        mesh = _thinned(len(points), 12_000)
        self.points, self.normals = points[mesh] - self.base, normals[mesh]
        self.tree = cKDTree(self.points)
        self.extents = high - low
        self.seen, self.free_depth = seen, free_depth
        self.seen_tree = cKDTree(seen.points)
        self.low, self.high = seen.box
        self.width = np.maximum(self.high - self.low, 1e-3)
        self.near_m = max(_NEAR_M, _NEAR_SHARE * float(self.width.max()))

    def candidates(self) -> list[Pose]:
        """Return the poses of least cost among all headings, scales and positions."""
        poses = []
        for heading in np.arange(_HEADINGS) * (2 * np.pi / _HEADINGS):
            turned = self.points[:, :2] @ Pose(heading, 1.0, np.zeros(3)).rotation[:2, :2].T
            low, high = turned.min(axis=0), turned.max(axis=0)
            size = np.array([*(high - low), self.extents[2]])
            for scale in self._scales(size):
                poses += [
                    Pose(heading, scale, place)
                    for place in self._places(scale * size, scale * (low + high) / 2)
                ]
        return self.best(poses, _REFINED, _TRIED)

    def _scales(self, size: np.ndarray) -> list[float]:
        """Return scales at which a turned mesh of that size is as high or as wide as the seen points."""
        ratio = self.width / np.maximum(size, 1e-9)
        out: list[float] = []
        for scale in (ratio[2], ratio.max(), ratio[:2].max(), np.sqrt(ratio[2] * ratio[:2].max())):
            if all(abs(np.log(scale / other)) > _SAME_SCALE for other in out):
                out.append(float(scale))
        return out

    def _places(self, size: np.ndarray, middle: np.ndarray) -> list[np.ndarray]:
        """Return positions of the bottom center: the smaller box at the middle of the larger one, or at its ends."""
        ends = []
        for axis in range(2):
            center = (self.low[axis] + self.high[axis]) / 2
            slack = (size[axis] - self.width[axis]) / 2
            offsets = (0.0,) if slack < _SLACK * size[axis] else (-slack, 0.0, slack)
            ends.append([center + offset - middle[axis] for offset in offsets])
        bottoms = [self.low[2]]
        if self.seen.floor_z is None and abs(size[2] - self.width[2]) > _SLACK * size[2]:
            bottoms.append(self.high[2] - size[2])
        return [np.array([x, y, z]) for x in ends[0] for y in ends[1] for z in bottoms]

    def best(self, poses: list[Pose], kept: int, count: int) -> list[Pose]:
        """Return the `kept` poses of least cost, ascending."""
        order = np.argsort([self._cost(pose, count) for pose in poses], kind="stable")
        return [poses[k] for k in order[:kept]]

    def _cost(self, pose: Pose, count: int) -> float:
        """Return the mean truncated distance of seen points plus the mean truncated intrusion of the mesh."""
        distance, _, facing = self._to_mesh(pose, _thinned(len(self.seen.points), count))
        distance = np.where(facing, distance, distance + 0.5 * self.near_m)
        near = 0.5 * self.near_m
        unexplained = np.minimum(distance / near, 3.0).mean() / 3.0
        mesh = _thinned(len(self.points), 2 * count)
        depth = self._intrusion(pose.apply(self.points[mesh]))
        return float(unexplained + np.minimum(depth / near, 1.0).mean())

    def _intrusion(self, points: np.ndarray) -> np.ndarray:
        """Return the depth (n,) of points in free space, or below the support."""
        depth = self.free_depth(points)
        if self.seen.floor_z is None:
            return depth
        return np.maximum(depth, self.seen.floor_z - points[:, 2])

    def _to_mesh(self, pose: Pose, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return distances (n,) of seen points to the mesh, their nearest points on it, and whether normals agree."""
        points = self.seen.points[rows]
        _, nearest = self.tree.query(pose.undo(points))
        offset = pose.apply(self.points[nearest]) - points
        normal = self.normals[nearest] @ pose.rotation.T
        along = np.einsum("nk,nk->n", offset, normal)
        # The surface continues between its points: tangential distances up to their spacing are free.
        sideways = np.linalg.norm(offset - along[:, None] * normal, axis=1)
        spacing = pose.scale * self._spacing
        distance = np.hypot(along, np.maximum(sideways - spacing, 0.0))
        known = np.linalg.norm(self.seen.normals[rows], axis=1) > 0.5
        facing = ~known | (np.einsum("nk,nk->n", self.seen.normals[rows], normal) > _FACING)
        return distance, nearest, facing

    @cached_property
    def _spacing(self) -> float:
        """Median distance between neighboring points of the mesh, in its units."""
        return float(np.median(self.tree.query(self.points[::20], k=2)[0][:, 1]))

    def refine(self, pose: Pose, count: int, steps: int) -> Pose:
        """Refine a pose by robust symmetric ICP, mostly point to plane."""
        own = _thinned(len(self.seen.points), count)
        mesh = _thinned(len(self.points), count)
        for _ in range(steps):
            change = self._step(pose, own, mesh)
            if change is None:
                break
            place = pose.place + change[2:]
            pose = Pose(pose.heading + change[0], pose.scale * float(np.exp(change[1])), place)
            if np.abs(change[0]) < 1e-5 and np.abs(change[1:]).max() < 1e-5:
                break
        return pose

    def _step(self, pose: Pose, own: np.ndarray, mesh: np.ndarray) -> np.ndarray | None:
        """Return the change (5,) of heading, log scale and position from one set of pairs; None if there are few."""
        seen = self.seen.points[own]
        distance, nearest, facing = self._to_mesh(pose, own)
        near = np.quantile(distance, _TRIMMED)
        keep = facing & (distance <= max(near, 1e-4))
        if keep.sum() < 12:
            return None
        typical = max(float(np.median(distance[keep])), 5e-4)
        moved = [pose.apply(self.points[nearest[keep]])]
        target, normal = [seen[keep]], [self.normals[nearest[keep]] @ pose.rotation.T]
        # From the mesh only near seen points, as its unseen side has no partner.
        there = pose.apply(self.points[mesh])
        gap, partner = self.seen_tree.query(there, distance_upper_bound=4 * typical + 0.002)
        found = np.isfinite(gap)
        partner = np.where(found, partner, 0)
        turned = self.normals[mesh] @ pose.rotation.T
        partner_normal = self.seen.normals[partner]
        known = np.linalg.norm(partner_normal, axis=1) > 0.5
        found &= ~known | (np.einsum("nk,nk->n", partner_normal, turned) > _FACING)
        moved.append(there[found])
        target.append(self.seen.points[partner[found]])
        normal.append(np.where(known[found, None], partner_normal[found], turned[found]))
        return self._solve(
            pose, np.concatenate(moved), np.concatenate(target), np.concatenate(normal), typical
        )

    def _solve(
        self, pose: Pose, moved: np.ndarray, target: np.ndarray, normal: np.ndarray, typical: float
    ) -> np.ndarray:
        """Solve the pairs' least squares, with Geman-McClure weights of the distance along the normal."""
        offset = target - moved
        along = np.einsum("nk,nk->n", offset, normal)
        weight = 1.0 / (1.0 + (along / (2 * typical)) ** 2) ** 2
        arm = moved - pose.place
        turn = np.stack([-arm[:, 1], arm[:, 0], np.zeros(len(arm))], -1)
        columns = np.stack(
            [turn, arm, *np.broadcast_to(np.eye(3)[:, None, :], (3, len(arm), 3))], 1
        )  # (n, 5, 3)
        plane = np.einsum("nck,nk->nc", columns, normal)
        normal_matrix = np.einsum("n,na,nb->ab", weight, plane, plane)
        right = np.einsum("n,na,n->a", weight, plane, along)
        slide = _SIDEWAYS**2 * weight
        normal_matrix += np.einsum("n,nak,nbk->ab", slide, columns, columns)
        right += np.einsum("n,nak,nk->a", slide, columns, offset)
        size = float(self.width.max())
        # Damping keeps what the pairs do not determine, such as the heading of a jar.
        scale = np.array([size, size, 1.0, 1.0, 1.0]) ** 2 * weight.sum()
        normal_matrix += np.diag(_DAMPING * scale)
        free = [0, 1, 2, 3] if self.seen.floor_z is not None else [0, 1, 2, 3, 4]
        change = np.zeros(5)
        change[free] = np.linalg.solve(normal_matrix[np.ix_(free, free)], right[free])
        change[1] = np.clip(change[1], -0.1, 0.1)
        change[0] = np.clip(change[0], -0.2, 0.2)
        return change

    def registration(self, pose: Pose) -> Registration:
        """Measure the residuals of a pose on all seen points."""
        distance, _, _ = self._to_mesh(pose, _thinned(len(self.seen.points), 8000))
        depth = self._intrusion(pose.apply(self.points))
        rotation = pose.rotation
        return Registration(
            scale=pose.scale,
            rotation=rotation,
            translation=pose.place - pose.scale * rotation @ self.base,
            distance_m=float(np.median(distance)),
            near_m=self.near_m,
            missed=float((distance > self.near_m).mean()),
            intruding=float((depth > self.near_m).mean()),
        )


def _thinned(total: int, count: int) -> np.ndarray:
    """Return at most `count` evenly spaced row numbers of `total`."""
    return np.unique(np.linspace(0, total - 1, min(total, count)).round().astype(np.int64))
