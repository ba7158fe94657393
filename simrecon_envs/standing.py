"""Find a collision-free robot base from which a target and its goals are in reach: solids + robot -> Placement.

A mounted arm stands on a pedestal at the height of the target's support (as in most tabletop tasks), or on the support
itself if there is no space beside it. A mobile robot stands on the floor. Candidates lie on circles around the target;
the first collision-free one in order of preference is chosen. If there is none, an arm may be raised or turned aside.
NumPy only.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from simrecon_envs.occupancy import ConvexSolid, OccupancyGrid
from simrecon_envs.placement import Placement, PlacementConfig, Target, within_reach
from simrecon_envs.robots import RobotShape, RobotTraits

_RAISED_M = (0.0, 0.12, 0.24)  # heights of an arm above the support, in order of preference
_GOAL_CELL_M = 0.06  # goals are thinned to one per cell
_ASIDE_RAD = (0.0, 0.5, -0.5)  # yaws of an arm relative to the target


class Places:
    """Placement search for one robot in one scene; caches results per target."""

    def __init__(
        self,
        solids: list[ConvexSolid],
        floor_ids: set[int],
        wall_ids: set[int],
        shape: RobotShape,
        traits: RobotTraits,
        config: PlacementConfig,
    ) -> None:
        """Fill the occupancy grids.

        Args:
            solids: All convex solids of the scene.
            floor_ids: Owners that are floors.
            wall_ids: Owners that are walls.
            shape: The robot at rest.
            traits: The robot's reach and size.
            config: Parameters of the search.
        """
        self._solids = [s for s in solids if s.owner not in floor_ids]
        self._shape, self._traits, self._config = shape, traits, config
        lower = np.min([s.lower for s in self._solids], axis=0) if self._solids else np.zeros(3)
        upper = np.max([s.upper for s in self._solids], axis=0) if self._solids else np.zeros(3)
        self._box = lower, upper
        window = lower - 0.1, upper + 0.1
        self._grid = OccupancyGrid(self._solids, *window, margin_m=config.clearance_m)
        self._things = OccupancyGrid(self._solids, *window, margin_m=0.0)
        self._walls = OccupancyGrid([s for s in self._solids if s.owner in wall_ids], *window, margin_m=0.0)
        self._rings: dict[int, np.ndarray] = {}
        self._pedestals: dict[tuple[float, ...], float | None] = {}

    def find(self, targets: list[Target], interests: list[np.ndarray]) -> Placement:
        """Return a collision-free place within reach of a target; earlier targets are preferred.

        If no target can be reached, return the nearest free place, with a note.

        Args:
            targets: Targets, best first.
            interests: Arrays of goals (k, 3), world; one goal of each array must be within reach, too.
        """
        for target in sorted(targets, key=lambda target: bool(target.problem)):
            near = 2 * self._traits.reach_m[2]
            wanted = [target.center[None], *(_thinned(goals, target.center, near) for goals in interests)]
            for positions, yaws in self._tries(target, interests):
                within = np.ones(len(positions), bool)
                for goals in wanted:
                    within &= within_reach(positions[:, None], yaws[:, None], goals, self._traits).any(axis=1)
                for position, yaw in zip(positions[within], yaws[within], strict=True):
                    placement = Placement(position, float(yaw), 0.0, target, "")
                    pedestal = self._stands(target, placement)
                    if pedestal is not None:
                        return replace(placement, pedestal_m=pedestal)
        return self._anywhere(targets[0] if targets else None)

    def _tries(self, target: Target, interests: list[np.ndarray]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Yield batches of root positions (n, 3) and yaws (n,), best first."""
        if self._traits.mobile:
            low, high = self._traits.work_height_m
            heights = [0.0] if low - 0.3 <= target.center[2] <= high else []
            raised, aside = (0.0,), (0.0,)
        else:
            heights, raised, aside = [max(target.bottom_m, 0.0)], _RAISED_M, _ASIDE_RAD
            for goals in interests:
                # If target and goals differ in height, try the mean height, too.
                between = (target.bottom_m + float(np.median(goals[:, 2]))) / 2
                if abs(between - target.bottom_m) > 0.1:
                    heights.append(max(between, 0.0))
        if not heights:
            return
        ring = self._ring(target)
        xy = np.repeat(ring[:, :2], len(heights), axis=0)
        yaw = np.repeat(ring[:, 2], len(heights))
        for lift in raised:
            positions = np.column_stack([xy, np.tile(np.array(heights) + lift, len(ring))])
            for turn in aside:
                yield positions, yaw + turn

    def _ring(self, target: Target) -> np.ndarray:
        """Return places around a target (n, 3), best first: x, y, yaw towards the target."""
        if target.id not in self._rings:
            least, best, most = self._traits.reach_m
            radius, direction = (
                x.ravel() for x in np.meshgrid(np.linspace(least, most, self._config.radii),
                                               np.arange(self._config.directions), indexing="ij")
            )  # fmt: skip
            angle = 2 * np.pi * direction / self._config.directions
            outward = np.stack([np.cos(angle), np.sin(angle)], axis=1)
            # Prefer a free approach path of the hand, from the robot's side above the target.
            along = np.linspace(0.06, radius, 12, axis=1)
            way = target.center[:2] + along[..., None] * outward[:, None]
            way = np.concatenate([way, target.top_m + 0.10 + 0.3 * along[..., None]], axis=2)
            cost = np.abs(radius - best) / (most - least) + 2.0 * self._things.occupied(way).mean(axis=1)
            order = np.lexsort((direction, cost.round(6)))
            xy = target.center[:2] + radius[:, None] * outward
            self._rings[target.id] = np.column_stack([xy, angle + np.pi])[order]
        return self._rings[target.id]

    def _stands(self, target: Target, placement: Placement) -> float | None:
        """Return the height of the pedestal; None if the robot collides or a wall separates it from the target."""
        key = (target.id, *placement.position.tolist(), placement.yaw_rad)
        if key not in self._pedestals:
            sees = _sees_over_walls(self._walls, placement, target)
            arguments = (self._grid, self._solids, placement, self._shape, self._traits)
            self._pedestals[key] = _pedestal(*arguments) if sees else None
        return self._pedestals[key]

    def _anywhere(self, target: Target | None) -> Placement:
        """Return the collision-free place on the floor nearest to the target, or to the middle of the scene."""
        lower, upper = self._box
        goal = target.center if target is not None else (lower + upper) / 2
        lower, upper = np.minimum(lower, 0) - 1.0, np.maximum(upper, 2.0) + 1.0
        note = "" if target is None else f"the robot cannot reach object {target.id} ({target.label})"
        reach = float(np.linalg.norm((upper - lower)[:2])) + 1.0
        for radius in np.arange(self._traits.reach_m[1], reach + 0.3, 0.15):
            for direction in range(24):
                angle = 2 * np.pi * direction / 24
                position = np.array([goal[0] + radius * np.cos(angle), goal[1] + radius * np.sin(angle), 0.0])
                placement = Placement(position, angle + np.pi, 0.0, target, note)
                if not self._grid.occupied(placement.to_world(self._shape.points)).any():
                    return placement
        # The last circle lies outside the grid, which is free.
        raise AssertionError("no free place, not even outside the scene")


def _thinned(goals: np.ndarray, center: np.ndarray, near_m: float) -> np.ndarray:
    """Return the goals (k, 3) within `near_m` of a centre, one per grid cell."""
    goals = goals[np.linalg.norm(goals[:, :2] - center[:2], axis=1) <= near_m]
    _, first = np.unique(np.floor(goals / _GOAL_CELL_M).astype(int), axis=0, return_index=True)
    return goals[np.sort(first)]


def _sees_over_walls(walls: OccupancyGrid, placement: Placement, target: Target) -> bool:
    """Return whether the robot and the target are in the same room: two line-of-sight tests against walls."""
    shares = np.linspace(0, 1, 40)[:, None]
    for lift in (0.1, 0.5):
        start = placement.position + np.array([0, 0, lift])
        if walls.occupied(start + shares * (target.center + np.array([0, 0, 0.05]) - start)).any():
            return False
    return True


def _pedestal(
    grid: OccupancyGrid,
    solids: list[ConvexSolid],
    placement: Placement,
    shape: RobotShape,
    traits: RobotTraits,
) -> float | None:
    """Return the height of the pedestal under a robot, or None if robot or pedestal collide."""
    points = shape.points
    high = points[points[:, 2] > 0.05]
    if grid.occupied(placement.to_world(high[::16])).any():  # rejects most places fast
        return None
    below, floor = placement.position[2], 0.0
    if not traits.mobile:
        disk = _disk(traits.footprint_radius_m)
        column = np.arange(0.03, max(below - 0.03, 0.03), 0.04)
        free = not grid.occupied(placement.to_world(disk[None] - [0, 0, 1] * column[:, None, None])).any()
        if not free:
            top = _support_top(solids, placement.to_world(disk), below)
            if top is None:
                return None
            # It stands on the support: ignore its lowest 5 cm, the foot in contact.
            floor = top
            points = points[points[:, 2] > 0.05]
            foot = placement.to_world(disk + np.array([0, 0, 0.05]))
            if grid.occupied(foot).any():
                return None
    world = placement.to_world(points)
    # The grid has no floor, which a mobile robot's wheels touch.
    if grid.occupied(world).any() or (not traits.mobile and (world[:, 2] < -0.005).any()):
        return None
    return max(below - floor, 0.0)


def _disk(radius: float) -> np.ndarray:
    """Sample points (n, 3) of a disk at z = 0, at most 3 cm apart."""
    axis = np.arange(-radius, radius + 1e-9, radius / max(int(np.ceil(radius / 0.03)), 1))
    x, y = np.meshgrid(axis, axis)
    inside = x**2 + y**2 <= radius**2 + 1e-9
    return np.stack([x[inside], y[inside], np.zeros(inside.sum())], axis=1)


def _support_top(solids: list[ConvexSolid], disk: np.ndarray, height: float) -> float | None:
    """Return the height of the horizontal surface just below `height` that supports the whole disk (n, 3), or None."""
    carried = np.zeros(len(disk), bool)
    tops = []
    corners = disk[:, :2].min(axis=0), disk[:, :2].max(axis=0)
    for solid in solids:
        if not height - 0.03 <= solid.upper[2] <= height + 0.01:
            continue
        if (solid.lower[:2] > corners[1]).any() or (solid.upper[:2] < corners[0]).any():
            continue
        probe = np.column_stack([disk[:, :2], np.full(len(disk), solid.upper[2] - 0.004)])
        inside = (probe @ solid.half_spaces[:, :3].T + solid.half_spaces[:, 3] <= 1e-6).all(axis=1)
        if inside.any():
            carried |= inside
            tops.append(solid.upper[2])
    return max(tops) if tops and carried.all() else None
