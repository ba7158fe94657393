"""Navigate: drive to an object and stop facing it. For robots with a mobile base."""

import functools
from collections import deque
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch

from simrecon_envs.arrays import (
    Array,
    atan2,
    clamp,
    column,
    largest,
    norm,
    numpy,
    pick,
    real,
    rotate,
    smallest,
    stack,
    tanh,
    where,
)
from simrecon_envs.occupancy import OccupancyGrid
from simrecon_envs.oracle import Hand
from simrecon_envs.placement import Placement, describe_target
from simrecon_envs.tasks.base import Info, Pair, Task, draw
from simrecon_envs.tasks.facts import SceneFacts
from simrecon_envs.tasks.spec import TaskSpec

WITHIN_M = 0.90  # greatest distance from the base center to the object's outline
FACING_RAD = 0.35
_STILL_M_S = 0.1
_CELL_M = 0.08  # of the occupancy grid
_ROBOT_HEIGHT_M = 1.2  # obstacles above are ignored
_CLEARANCE_M = 0.06  # between base and obstacles
_START_AWAY_M = (1.2, 3.0)  # least and greatest path length from a start to the goal
_NEIGHBORS = ((1, 0), (-1, 0), (0, 1), (0, -1))
_FORWARD = np.array([[1.0, 0.0, 0.0]])  # in the frame of the base
_MARGIN_M = 2.0  # of the grid around the scene


class Navigate(Task):
    """Success: the base within 90 cm of the object's outline, facing it to 20 degrees, and still."""

    kind = "navigate"
    sentence = "Drive to the {subject}."
    max_reward = 3.0
    mobile_only = True
    lasting = False

    @classmethod
    def options(cls, facts: SceneFacts) -> list[Pair]:
        """Return all objects but those that hang."""
        return [(item.id, None) for item in facts.bundle.objects if not facts.hangs(item.id)]

    @classmethod
    def problems(cls, facts: SceneFacts, subject: int | None, place: int | None) -> list[str]:
        """Return the reason: the robot does not drive."""
        return [] if facts.traits.mobile else [f"robot {facts.robot!r} does not drive"]

    @classmethod
    def plan(cls, facts: SceneFacts, spec: TaskSpec) -> Placement:
        """Return a placement near the object; its note tells if no start has a free path to it."""
        floor = floor_plan(facts)
        item = next(o for o in facts.bundle.objects if o.id == spec.subject)
        target = describe_target(facts.bundle, item, facts.solids)
        near = floor.near(outline(facts, spec.subject_id))
        starts = floor.starts(near)
        note = "" if len(starts) else f"there is no free way to {facts.thing(spec.subject_id)}"
        spot = floor.center(near[0]) if len(near) else floor.any_free(target.center[:2])
        yaw = float(np.arctan2(*(target.center[:2] - spot)[::-1]))
        return Placement(np.array([*spot, 0.0]), yaw, 0.0, target, note)

    def prepare(self) -> None:
        """Find the goal cells and the starts; the placement is the only start where there are none."""
        self.floor = floor_plan(self.facts)
        self._outline = outline(self.facts, self.subject)
        self.near = self.floor.near(self._outline)
        self.starts = self.floor.starts(self.near)
        if not len(self.starts):
            self.starts = self.placement.position[None, :2]

    def start(self, env_idx: torch.Tensor, rng: Any) -> None:
        """Draw a start and a heading."""
        from mani_skill.utils.structs.pose import Pose

        draws = draw(rng, env_idx, 2)
        spots = self.starts[(draws[:, 0] * len(self.starts)).astype(int)]
        yaw = 2 * np.pi * draws[:, 1]
        zero = np.zeros(len(yaw))
        position = torch.as_tensor(np.column_stack([spots, zero]), dtype=torch.float32)
        quat = np.stack([np.cos(yaw / 2), zero, zero, np.sin(yaw / 2)], axis=1)
        quat = torch.as_tensor(quat, dtype=torch.float32)
        pose = Pose.create_from_pq(position, quat, device=self.env.device)
        self.env.agent.robot.set_pose(pose)  # pyright: ignore[reportArgumentType]
        self._points = self.env.measures.array(self._outline)

    def _base(self) -> tuple[Array, Array]:
        """Return the position (b, 2) and the heading (b, 2), a unit vector, of the base."""
        measures = self.env.measures
        agent: Any = self.env.agent  # with a mobile base
        pose = measures.link_pose(agent.base_link)
        return pose[:, :2], rotate(pose[:, 3:], measures.array(_FORWARD))[:, :2]

    def evaluate(self) -> Info:
        """Return success: near, facing, still."""
        here, ahead = self._base()
        ways = self._points[None] - here[:, None]
        lengths = norm(ways)
        distance, way = smallest(lengths), pick(ways, lengths.argmin(1))
        middle = self._points.mean(0)[None] - here
        off = smallest(stack([_angle(ahead, way), _angle(ahead, middle)]))
        still = largest(abs(self.env.measures.qvel[:, :3])) <= _STILL_M_S
        near, facing = distance <= WITHIN_M, off <= FACING_RAD
        return {"success": near & facing & still, "is_near": near, "is_facing": facing, "is_still": still,
                "distance_m": distance, "off_rad": off}  # fmt: skip

    def reward(self, info: Info) -> Array:
        """Return 0 to 1.5 for approaching, plus 0 to 1 for facing the object when near."""
        far = clamp(info["distance_m"] - WITHIN_M, 0.0)
        facing = 1 - clamp(info["off_rad"] / np.pi, most=1.0)
        reward = 1.5 * (1 - tanh(0.7 * far)) + real(info["is_near"]) * facing
        return where(info["success"], self.max_reward, reward)

    def observe(self, info: Info) -> dict[str, Array]:
        """Return the pose of the base, and the object in the base's frame."""
        here, ahead = self._base()
        way = self._points.mean(0)[None] - here
        # In the base's frame: forward, left.
        local = stack([(way * ahead).sum(1), way[:, 1] * ahead[:, 0] - way[:, 0] * ahead[:, 1]])
        return {"base_position": here, "base_ahead": ahead, "target_from_base": local,
                "distance": column(info["distance_m"])}  # fmt: skip

    def script(self, hand: Hand) -> Iterator[np.ndarray]:
        """Drive along the planned path, turn to the object, wait."""
        here = numpy(self._base()[0])[0]
        for point in self.floor.path(here, self.near):
            yield from hand.drive(self._base, lambda point=point: point, 0.10)
        middle = self._outline.mean(axis=0)
        yield from hand.face(self._base, lambda: self._closest(middle))
        yield from hand.wait(15)

    def _closest(self, middle: np.ndarray) -> np.ndarray:
        here = numpy(self._base()[0])[0]
        point = self._outline[np.argmin(np.linalg.norm(self._outline - here, axis=1))]
        return point if np.linalg.norm(point - here) > 0.3 else middle


@functools.lru_cache(maxsize=4)
def floor_plan(facts: SceneFacts) -> "FloorPlan":
    """Return the floor plan of a scene, from a cache of four."""
    return FloorPlan(facts)


class FloorPlan:
    """Occupancy grid of the floor for a robot base, and paths on it.

    Cells are (row, column) indices of `free`, points are world xy in metres.
    """

    def __init__(self, facts: SceneFacts) -> None:
        """Mark the cells whose distance to all obstacles exceeds the robot's radius."""
        from scipy import ndimage

        upright = [s for s in facts.solids if s.owner not in facts.floor_ids and s.lower[2] < _ROBOT_HEIGHT_M]
        boxes = [s for s in upright if s.upper[2] > 0.03]
        lower = np.min([s.lower[:2] for s in facts.solids], axis=0)
        upper = np.max([s.upper[:2] for s in facts.solids], axis=0)
        self.lower = lower - _MARGIN_M
        corners = np.array([*self.lower, 0.03]), np.array([*(upper + _MARGIN_M), _ROBOT_HEIGHT_M])
        grid = OccupancyGrid(boxes, *corners, cell_m=_CELL_M, margin_m=-_CELL_M / 2)
        room = np.asarray(ndimage.distance_transform_edt(~grid.filled.any(axis=2))) * _CELL_M
        self.free = room > facts.traits.footprint_radius_m + _CLEARANCE_M

    def center(self, cell: np.ndarray) -> np.ndarray:
        """Return the centers (..., 2) of cells (..., 2)."""
        return self.lower + (np.asarray(cell) + 0.5) * _CELL_M

    def near(self, points: np.ndarray) -> np.ndarray:
        """Return the free cells (k, 2) within 80 cm of an outline (p, 2), the farthest first."""
        cells = np.argwhere(self.free)
        ways = np.linalg.norm(self.center(cells)[:, None] - points[None], axis=2)
        keep = ways.min(axis=1) <= WITHIN_M - 0.10
        return cells[keep][np.argsort(ways.min(axis=1)[keep], kind="stable")[::-1]]

    def starts(self, near: np.ndarray) -> np.ndarray:
        """Return points (k, 2), at most about 200, whose shortest path to the cells `near` is 1.2 to 3 m long."""
        if not len(near):
            return np.zeros((0, 2))
        steps = self._distances(near)
        far = (steps * _CELL_M >= _START_AWAY_M[0]) & (steps * _CELL_M <= _START_AWAY_M[1])
        cells = np.argwhere(far)
        return self.center(cells)[:: max(len(cells) // 200, 1)] if len(cells) else np.zeros((0, 2))

    def any_free(self, point: np.ndarray) -> np.ndarray:
        """Return the center (2,) of the free cell nearest to a point (2,)."""
        cells = self.center(np.argwhere(self.free))
        return cells[np.argmin(np.linalg.norm(cells - point, axis=1))]

    def path(self, start: np.ndarray, near: np.ndarray) -> list[np.ndarray]:
        """Return waypoints (2,) from a point (2,) to the nearest of the cells `near`.

        The shortest path on the grid is shortened to segments that stay in free cells.
        """
        steps = self._distances(near)
        reachable = np.argwhere(np.isfinite(steps))
        cell = reachable[np.argmin(np.linalg.norm(self.center(reachable) - start, axis=1))]
        cells = [cell]
        while steps[tuple(cell)] > 0:
            cell = min((cell + d for d in _NEIGHBORS), key=lambda c: steps[tuple(c)])
            cells.append(cell)
        points, kept = [self.center(c) for c in cells], [self.center(cells[0])]
        k = 0
        while k < len(points) - 1:
            ahead = [j for j in range(k + 1, len(points)) if self._straight(points[k], points[j])]
            k = max(ahead, default=k + 1)
            kept.append(points[k])
        return kept[1:]

    def _straight(self, first: np.ndarray, second: np.ndarray) -> bool:
        count = max(int(np.linalg.norm(second - first) / (_CELL_M / 3)), 1)
        points = first + np.linspace(0, 1, count + 1)[:, None] * (second - first)
        cells = np.floor((points - self.lower) / _CELL_M).astype(int).clip(0, np.array(self.free.shape) - 1)
        return bool(self.free[cells[:, 0], cells[:, 1]].all())

    def _distances(self, goals: np.ndarray) -> np.ndarray:
        """Return the path length in cells (breadth-first search) to the nearest goal; inf where there is no path."""
        steps = np.full((self.free.shape[0] + 2, self.free.shape[1] + 2), np.inf)
        open_cells = np.pad(self.free, 1)
        queue = deque()
        for cell in goals:
            steps[cell[0] + 1, cell[1] + 1] = 0
            queue.append((int(cell[0]) + 1, int(cell[1]) + 1))
        while queue:
            x, y = queue.popleft()
            for dx, dy in _NEIGHBORS:
                nx, ny = x + dx, y + dy
                if open_cells[nx, ny] and steps[nx, ny] == np.inf:
                    steps[nx, ny] = steps[x, y] + 1
                    queue.append((nx, ny))
        return steps[1:-1, 1:-1]


def outline(facts: SceneFacts, key: int) -> np.ndarray:
    """Sample the convex hull of an object, seen from above, as points (p, 2) at most 6 cm apart."""
    from scipy.spatial import ConvexHull

    cloud = np.concatenate([s.vertices[:, :2] for s in facts.solids if s.owner == key])
    ring = cloud[ConvexHull(cloud).vertices]
    points = []
    for first, second in zip(ring, np.roll(ring, -1, axis=0), strict=True):
        count = max(int(np.ceil(np.linalg.norm(second - first) / 0.06)), 1)
        points.append(first + np.arange(count)[:, None] / count * (second - first))
    return np.concatenate(points)


def _angle(first: Array, second: Array) -> Array:
    """Return the unsigned angle (b,) between vectors (b, 2)."""
    cross = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    return abs(atan2(cross, (first * second).sum(1)))
