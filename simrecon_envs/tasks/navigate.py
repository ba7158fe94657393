"""Navigate: drive to an object and stand before it, facing it. For robots that drive."""

import functools
from collections import deque
from collections.abc import Iterator

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
from simrecon_envs.occupancy import ConvexSolid, OccupancyGrid
from simrecon_envs.placement import Placement, describe_target
from simrecon_envs.tasks.base import Info, Task, draw
from simrecon_envs.tasks.facts import SceneFacts
from simrecon_envs.tasks.spec import TaskSpec

WITHIN_M = 0.90  # from the middle of the base to the nearest point of the object
FACING_RAD = 0.35
_STILL_M_S = 0.1
_CELL_M = 0.08
_ROBOT_HEIGHT_M = 1.2
_START_AWAY_M = 1.2
_MARGIN_M = 2.0  # around the scene


class Navigate(Task):
    """The base within 90 cm of the object's outline, facing it to 20 degrees, and still."""

    kind = "navigate"
    joint = ""
    max_reward = 3.0
    mobile_only = True
    lasting = False

    @classmethod
    def options(cls, facts: SceneFacts) -> list[tuple[int | None, int | None]]:
        return [(item.id, None) for item in facts.bundle.objects if not facts.hangs(item.id)]

    @classmethod
    def problems(cls, facts: SceneFacts, subject: int | None, place: int | None) -> list[str]:
        return [] if facts.traits.mobile else [f"robot {facts.robot!r} does not drive"]

    @classmethod
    def plan(cls, facts: SceneFacts, spec: TaskSpec) -> Placement:
        """Return a place before the object that the robot can drive to; the note says where there is none."""
        floor = floor_plan(facts)
        item = next(o for o in facts.bundle.objects if o.id == spec.subject)
        target = describe_target(facts.bundle, item, facts.solids)
        near = floor.near(outline(facts, spec.subject))
        starts = floor.starts(near)
        note = "" if len(starts) else f"there is no free way to {facts.thing(spec.subject)}"
        spot = floor.center(near[0]) if len(near) else floor.any_free(target.center[:2])
        yaw = float(np.arctan2(*(target.center[:2] - spot)[::-1]))
        return Placement(np.array([*spot, 0.0]), yaw, 0.0, target, note)

    def __init__(self, env: object, spec: TaskSpec, placement: Placement) -> None:
        super().__init__(env, spec, placement)
        self.floor = floor_plan(self.facts)
        self._outline = outline(self.facts, spec.subject)
        self.near = self.floor.near(self._outline)
        self.starts = self.floor.starts(self.near)
        if not len(self.starts):
            self.starts = placement.position[None, :2]

    @classmethod
    def words(cls, facts: SceneFacts, spec: TaskSpec) -> str:
        return f"Drive to the {facts.thing(spec.subject)}."

    def start(self, env_idx: torch.Tensor, rng: object) -> None:
        from mani_skill.utils.structs.pose import Pose

        draws = draw(rng, env_idx, 2)
        spots = self.starts[(draws[:, 0] * len(self.starts)).astype(int)]
        yaw = 2 * np.pi * draws[:, 1]
        zero = np.zeros(len(yaw))
        position = torch.as_tensor(np.column_stack([spots, zero]), dtype=torch.float32)
        quat = torch.as_tensor(
            np.stack([np.cos(yaw / 2), zero, zero, np.sin(yaw / 2)], axis=1), dtype=torch.float32
        )
        self.env.agent.robot.set_pose(Pose.create_from_pq(position, quat, device=self.env.device))
        self._points = self.env.measures.array(self._outline)

    def _base(self) -> tuple[Array, Array]:
        """Return where the base is (b, 2) and where it faces (b, 2)."""
        measures = self.env.measures
        pose, ahead = measures.link_pose(self.env.agent.base_link), measures.array([[1.0, 0.0, 0.0]])
        return pose[:, :2], rotate(pose[:, 3:], ahead)[:, :2]

    def evaluate(self) -> Info:
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
        far = clamp(info["distance_m"] - WITHIN_M, 0.0)
        facing = 1 - clamp(info["off_rad"] / np.pi, most=1.0)
        reward = 1.5 * (1 - tanh(0.7 * far)) + real(info["is_near"]) * facing
        return where(info["success"], self.max_reward, reward)

    def observe(self, info: Info) -> dict[str, Array]:
        here, ahead = self._base()
        way = self._points.mean(0)[None] - here
        # In the base's own axes: forward, left.
        local = stack([(way * ahead).sum(1), way[:, 1] * ahead[:, 0] - way[:, 0] * ahead[:, 1]])
        return {"base_position": here, "base_ahead": ahead, "target_from_base": local,
                "distance": column(info["distance_m"])}  # fmt: skip

    def script(self, hand: "Hand") -> Iterator[np.ndarray]:  # noqa: F821
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
    """Return where a scene's robot can drive; the last few are kept."""
    return FloorPlan(facts)


class FloorPlan:
    """Where the robot's base has room, in cells."""

    def __init__(self, facts: SceneFacts) -> None:
        """Draw the plan: cells farther from everything than the robot is wide."""
        from scipy import ndimage

        upright = [s for s in facts.solids if s.owner not in facts.floor_ids and s.lower[2] < _ROBOT_HEIGHT_M]
        boxes = [s for s in upright if s.upper[2] > 0.03]
        lower = np.min([s.lower[:2] for s in facts.solids], axis=0)
        upper = np.max([s.upper[:2] for s in facts.solids], axis=0)
        self.lower = lower - _MARGIN_M
        grid = OccupancyGrid(
            boxes,
            [*self.lower, 0.03],
            [*(upper + _MARGIN_M), _ROBOT_HEIGHT_M],
            cell_m=_CELL_M,
            margin_m=-_CELL_M / 2,
        )
        room = ndimage.distance_transform_edt(~grid.filled.any(axis=2)) * _CELL_M
        self.free = room > facts.traits.footprint_radius_m + 0.06
        self._facts = facts

    def center(self, cell: np.ndarray) -> np.ndarray:
        """Return the middle (..., 2) of cells (..., 2)."""
        return self.lower + (np.asarray(cell) + 0.5) * _CELL_M

    def near(self, points: np.ndarray) -> np.ndarray:
        """Return the free cells (k, 2) that are well within reach of an outline (p, 2), with nothing between."""
        cells = np.argwhere(self.free)
        ways = np.linalg.norm(self.center(cells)[:, None] - points[None], axis=2)
        keep = ways.min(axis=1) <= WITHIN_M - 0.10
        return cells[keep][np.argsort(ways.min(axis=1)[keep], kind="stable")[::-1]]

    def starts(self, near: np.ndarray) -> np.ndarray:
        """Return places (k, 2) from which one of the cells `near` can be driven to, not too near themselves."""
        if not len(near):
            return np.zeros((0, 2))
        steps = self._distances(near)
        far = (steps * _CELL_M >= _START_AWAY_M) & (steps * _CELL_M <= 3.0)
        cells = np.argwhere(far)
        return self.center(cells)[:: max(len(cells) // 200, 1)] if len(cells) else np.zeros((0, 2))

    def any_free(self, point: np.ndarray) -> np.ndarray:
        """Return the free place (2,) that is nearest to a point."""
        cells = self.center(np.argwhere(self.free))
        return cells[np.argmin(np.linalg.norm(cells - point, axis=1))]

    def path(self, start: np.ndarray, near: np.ndarray) -> list[np.ndarray]:
        """Return the way (2,) points from a place to the nearest of the cells, straightened."""
        steps = self._distances(near)
        reachable = np.argwhere(np.isfinite(steps))
        cell = reachable[np.argmin(np.linalg.norm(self.center(reachable) - start, axis=1))]
        cells = [cell]
        while steps[tuple(cell)] > 0:
            around = [cell + d for d in _AROUND]
            cell = min(around, key=lambda c: steps[tuple(c)])
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
        """Return how many cells every free cell is from the nearest goal; inf where there is no way."""
        steps = np.full((self.free.shape[0] + 2, self.free.shape[1] + 2), np.inf)
        open_cells = np.pad(self.free, 1)
        queue = deque()
        for cell in goals:
            steps[cell[0] + 1, cell[1] + 1] = 0
            queue.append((int(cell[0]) + 1, int(cell[1]) + 1))
        while queue:
            x, y = queue.popleft()
            for dx, dy in ((1, 0), (-1, 0), (0, 1), (0, -1)):
                nx, ny = x + dx, y + dy
                if open_cells[nx, ny] and steps[nx, ny] == np.inf:
                    steps[nx, ny] = steps[x, y] + 1
                    queue.append((nx, ny))
        return steps[1:-1, 1:-1]


_AROUND = [np.array(d) for d in ((1, 0), (-1, 0), (0, 1), (0, -1))]


def outline(facts: SceneFacts, key: int) -> np.ndarray:
    """Return points (p, 2), no farther apart than 6 cm, around an object seen from above."""
    from scipy.spatial import ConvexHull

    mine: list[ConvexSolid] = [s for s in facts.solids if s.owner == key]
    cloud = np.concatenate([s.vertices[:, :2] for s in mine])
    ring = cloud[ConvexHull(cloud).vertices]
    points = []
    for first, second in zip(ring, np.roll(ring, -1, axis=0), strict=True):
        count = max(int(np.ceil(np.linalg.norm(second - first) / 0.06)), 1)
        points.append(first + np.arange(count)[:, None] / count * (second - first))
    return np.concatenate(points)


def _angle(first: Array, second: Array) -> Array:
    cross = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    return abs(atan2(cross, (first * second).sum(1)))
