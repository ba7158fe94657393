"""Group objects that move together at a reset, and check new poses in top view: outlines and support heights."""

import functools
from dataclasses import dataclass

import numpy as np

from simrecon_envs.surfaces import CELL_M, height_map
from simrecon_envs.tasks.facts import SceneFacts

GAP_M = 0.004  # minimum distance between the outlines of two groups
_LEVEL_M = 0.006  # tolerance of the support's height
_ROBOT_GAP_M = 0.02  # minimum distance from the robot at rest
_AROUND_M = 0.5  # margin of a support's height map around a stack


@dataclass(frozen=True)
class Stack:
    """An object on an immovable support, with everything that stands on it, at the captured poses."""

    members: tuple[int, ...]
    hull: np.ndarray  # (h, 2) convex outline, counterclockwise in top view
    height: tuple[float, float]  # of its bottom and its top (m, world)
    start: dict[int, np.ndarray]  # world_from_object (4, 4) of its members
    top: np.ndarray  # (nx, ny) height of its support and of immovable obstacles
    own: np.ndarray  # (nx, ny) height of its support alone
    lower: np.ndarray  # (2,) corner of these maps

    def stands(self, hull: np.ndarray) -> bool:
        """Return whether the outline lies on the captured support height, without higher cells inside."""
        edge = np.floor((_along(hull) - self.lower) / CELL_M).astype(int)
        if (edge < 0).any() or (edge >= self.top.shape).any():
            return False
        outline = self.top[edge[:, 0], edge[:, 1]]
        if (np.abs(outline - self.height[0]) > _LEVEL_M).any():
            return False
        return bool((self.top[self._within(hull)] <= self.height[0] + _LEVEL_M).all())

    def rise(self, hull: np.ndarray) -> float:
        """Return by how much (m) the support is higher under an outline than under the captured one.

        Reconstructed supports are level to some millimetres; PhysX ejects an object that penetrates that deep.
        """
        return max(self._highest(hull) - self._stood_at, 0.0)

    @functools.cached_property
    def _stood_at(self) -> float:
        return self._highest(self.hull)

    def _highest(self, hull: np.ndarray) -> float:
        return float(self.own[self._within(hull)].max(initial=self.height[0] - _LEVEL_M))

    def _within(self, hull: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the indices (k,), (k,) of cells that an outline covers or touches."""
        least = np.floor((hull.min(axis=0) - self.lower) / CELL_M).astype(int).clip(0, self.own.shape)
        most = np.ceil((hull.max(axis=0) - self.lower) / CELL_M).astype(int).clip(0, self.own.shape)
        grid = np.mgrid[least[0] : most[0], least[1] : most[1]].reshape(2, -1)
        near = _outside(self.lower + (grid.T + 0.5) * CELL_M, hull) < CELL_M / 2
        return grid[0, near], grid[1, near]


@dataclass
class Group:
    """Stacks whose outlines overlap in top view; they move as one."""

    stacks: list[Stack]
    others: list["Group"]
    robot: np.ndarray  # (n, 3) points on the robot at rest, world
    robot_gap_m: float  # minimum distance from these

    @functools.cached_property
    def members(self) -> tuple[int, ...]:
        """Return the ids of its objects."""
        return tuple(key for stack in self.stacks for key in stack.members)

    @functools.cached_property
    def center(self) -> np.ndarray:
        """Return its center of rotation (2,)."""
        return np.mean([stack.hull.mean(axis=0) for stack in self.stacks], axis=0)

    @functools.cached_property
    def outlines(self) -> list[np.ndarray]:
        """Return the captured outlines of its stacks."""
        return [stack.hull for stack in self.stacks]

    @functools.cached_property
    def _beside(self) -> list[tuple[np.ndarray, float]]:
        """Return per stack the robot's points (n, 2) at its height, and their minimum distance (m)."""
        out = []
        for stack in self.stacks:
            low, high = stack.height
            z = self.robot[:, 2]
            near = (z > low - self.robot_gap_m) & (z < high + self.robot_gap_m)
            points = self.robot[near, :2]
            captured = float(_outside(points, stack.hull).min(initial=np.inf))
            out.append((points, min(captured, self.robot_gap_m)))
        return out

    def least_gap(self, other: "Group", mine: int, theirs: int) -> float:
        """Return the minimum distance (m) of two stacks: `GAP_M`, or their captured distance if that is smaller."""
        return min(gap(self.stacks[mine].hull, other.stacks[theirs].hull), GAP_M)

    def move(self, transform: np.ndarray, places: dict[int, list[np.ndarray]]) -> np.ndarray | None:
        """Check a horizontal move; return it raised to the supports' heights, or None if it collides.

        Args:
            transform: The move (4, 4), world space.
            places: Current outlines of the stacks of all groups, by Python `id`; updated on success.
        """
        hulls = [hull @ transform[:2, :2].T + transform[:2, 3] for hull in self.outlines]
        if not all(stack.stands(hull) for stack, hull in zip(self.stacks, hulls, strict=True)):
            return None
        for (points, least), hull in zip(self._beside, hulls, strict=True):
            if (_outside(points, hull) < least).any():
                return None
        if not all(self.clears(other, hulls, places[id(other)]) for other in self.others):
            return None
        places[id(self)] = hulls
        risen = transform.copy()
        risen[2, 3] = max(stack.rise(hull) for stack, hull in zip(self.stacks, hulls, strict=True))
        return risen

    def clears(self, other: "Group", hulls: list[np.ndarray], places: list[np.ndarray]) -> bool:
        """Return whether the outlines `hulls` of its stacks keep their distances from the `places` of another group."""
        return all(
            _boxes_apart(hull, place) or gap(hull, place) >= self.gaps[id(other), mine, theirs]
            for theirs, place in enumerate(places)
            for mine, hull in enumerate(hulls)
        )

    @functools.cached_property
    def gaps(self) -> dict[tuple[int, int, int], float]:
        """Return `least_gap` of all pairs of stacks, by Python `id` of the other group."""
        return {
            (id(other), mine, theirs): self.least_gap(other, mine, theirs)
            for other in self.others
            for mine in range(len(self.stacks))
            for theirs in range(len(other.stacks))
        }


def group_things(facts: SceneFacts, robot: np.ndarray, robot_gap_m: float = 0.0) -> list[Group]:
    """Return the groups of objects that move together, ordered by id.

    Args:
        facts: The scene.
        robot: Points (n, 3) on the robot at rest, world; obstacles.
        robot_gap_m: Additional distance from the robot, for randomized joints.
    """
    stacks, found = _stacks(facts), []
    left = set(range(len(stacks)))
    while left:
        together, new = set(), {min(left)}
        while new:
            together |= new
            rest = left - together
            new = {k for k in rest if any(gap(stacks[k].hull, stacks[n].hull) < 0 for n in together)}
        left -= together
        found.append(Group([stacks[k] for k in sorted(together)], [], robot, _ROBOT_GAP_M + robot_gap_m))
    for group in found:
        group.others = [other for other in found if other is not group]
    return found


def _stacks(facts: SceneFacts) -> list[Stack]:
    from scipy.spatial import ConvexHull

    items = {item.id: item for item in facts.bundle.objects}
    stacks = []
    for key in facts.movable:
        parent = facts.parent[key]
        if parent in facts.movable or facts.hangs(key):
            continue
        with_it = {key, *facts.above(key)}
        members = (key, *(k for k in facts.above(key) if k in facts.movable))
        cloud = np.concatenate([s.vertices for s in facts.solids if s.owner in with_it])
        flat = cloud[:, :2]
        hull = flat[ConvexHull(flat).vertices]
        target = facts.targets[key]
        window = (hull.min(axis=0) - _AROUND_M, hull.max(axis=0) + _AROUND_M)
        own = height_map([s for s in facts.solids if s.owner == parent], *window)
        fixed = [s for s in facts.solids if s.owner not in facts.movable and s.owner != parent]
        blocked = height_map([s for s in fixed if s.lower[2] < target.top_m], *window).top
        start = {k: np.asarray(items[k].world_from_object) for k in members}
        height = (float(target.bottom_m), float(cloud[:, 2].max()))
        top = np.where(blocked > target.bottom_m + _LEVEL_M, blocked, own.top)
        stacks.append(Stack(members, hull, height, start, top, own.top, own.lower))
    return stacks


def about(center: np.ndarray, shift: np.ndarray, turn: float) -> np.ndarray:
    """Return the transform (4, 4) that rotates about the vertical axis through `center` (2,) and shifts by (2,) m."""
    c, s = np.cos(turn), np.sin(turn)
    out = np.eye(4)
    out[:2, :2] = [[c, -s], [s, c]]
    out[:2, 3] = center + shift - out[:2, :2] @ center
    return out


def gap(first: np.ndarray, second: np.ndarray) -> float:
    """Return the largest separation (m) of two convex outlines (h, 2) along an edge normal (separating axis theorem).

    Negative if they overlap: the penetration depth.
    """
    gaps = []
    for hull in (first, second):
        normals = _normals(hull)
        a, b = first @ normals.T, second @ normals.T
        gaps.append(np.maximum(a.min(axis=0) - b.max(axis=0), b.min(axis=0) - a.max(axis=0)).max())
    return float(max(gaps))


def _boxes_apart(first: np.ndarray, second: np.ndarray) -> bool:
    """Return whether the bounding boxes of two outlines are more than `GAP_M` apart; a fast test before `gap`."""
    between = np.maximum(first.min(axis=0) - second.max(axis=0), second.min(axis=0) - first.max(axis=0))
    return bool(between.max() > GAP_M)


def _outside(points: np.ndarray, hull: np.ndarray) -> np.ndarray:
    """Return a lower bound (n,) of the distance (m) of points (n, 2) from a convex outline (h, 2); negative inside."""
    normals = _normals(hull)
    # Reduce along the first axis: NumPy reduces a short last axis slowly.
    return (normals @ points.T - (hull * normals).sum(axis=1)[:, None]).max(axis=0)


def _normals(hull: np.ndarray) -> np.ndarray:
    """Return the outward unit normals (h, 2) of the edges of a counterclockwise outline."""
    edges = _ends(hull) - hull
    normals = np.column_stack([edges[:, 1], -edges[:, 0]])
    return normals / np.sqrt((normals * normals).sum(axis=1, keepdims=True)).clip(1e-9)


def _along(hull: np.ndarray) -> np.ndarray:
    """Sample points (k, 2) on an outline, at most one cell apart."""
    edges = _ends(hull) - hull
    counts = np.maximum(np.ceil(np.sqrt((edges * edges).sum(axis=1)) / CELL_M).astype(int), 1)
    number = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)  # on its edge
    return np.repeat(hull, counts, axis=0) + np.repeat(edges, counts, axis=0) * (
        number / np.repeat(counts, counts)
    ).reshape(-1, 1)


def _ends(hull: np.ndarray) -> np.ndarray:
    """Return the end points (h, 2) of the edges of an outline."""
    return np.concatenate([hull[1:], hull[:1]])
