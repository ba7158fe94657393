"""What to pick up, and where the robot stands to reach it: bundle + robot -> Placement. NumPy only.

A mounted arm stands on a pedestal whose top is at the height of what the target stands on (as in most
tabletop tasks), or on the support itself where there is no room beside it; a mobile robot stands on the
floor. Candidates lie on circles around the target; the first one in order of preference wins where the
robot's rest pose touches nothing.
"""

from dataclasses import dataclass

import numpy as np

from registry import SceneBundle, UsageError
from registry.bundle import BundleObject
from simrecon_envs.occupancy import ConvexSolid, OccupancyGrid
from simrecon_envs.robots import RobotShape, RobotTraits


@dataclass(frozen=True)
class PlacementConfig:
    """How the robot's place is searched."""

    directions: int = 36
    """How many directions around the target are tried."""
    radii: int = 9
    """How many distances between the least and the greatest reach are tried."""
    clearance_m: float = 0.015
    """Least distance of the robot at rest from everything."""
    grip_margin_m: float = 0.008
    """How much wider than the object the gripper must open."""
    max_grip_mass_kg: float = 2.0
    """Heavier objects are not chosen as targets."""
    min_height_m: float = 0.02
    """Lower objects cannot be gripped from above."""


@dataclass(frozen=True)
class Target:
    """A candidate for picking up, all in world space."""

    id: int
    label: str
    center: np.ndarray  # float64 (3,) of its box
    bottom_m: float
    top_m: float
    grip_width_m: float  # its least horizontal width
    grip_yaw_rad: float  # direction in which it is that wide
    problem: str  # "" or why it can hardly be picked up


@dataclass(frozen=True)
class Placement:
    """Where the robot stands; `world_from_root` of the robot."""

    position: np.ndarray  # float64 (3,)
    yaw_rad: float
    pedestal_m: float  # height of the pedestal below it, 0 for none
    target: Target | None
    note: str  # "" or what is not as it should be

    @property
    def quat_wxyz(self) -> np.ndarray:
        """Return its orientation as a quaternion (4,)."""
        return np.array([np.cos(self.yaw_rad / 2), 0, 0, np.sin(self.yaw_rad / 2)])

    def to_world(self, points: np.ndarray) -> np.ndarray:
        """Take points (..., 3) from root to world space."""
        c, s = np.cos(self.yaw_rad), np.sin(self.yaw_rad)
        return points @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + self.position

    def reaches(self, points: np.ndarray, traits: RobotTraits) -> np.ndarray:
        """Return which world points (n, 3) are within the hand's reach (n,)."""
        return within_reach(self.position, points, traits)


def within_reach(root: np.ndarray, points: np.ndarray, traits: RobotTraits) -> np.ndarray:
    """Return which points (n, 3) a robot whose root is at (3,) reaches: in a ring, at heights it works at."""
    away = np.linalg.norm(points[:, :2] - root[:2], axis=1)
    height = points[:, 2] - root[2]
    low, high = traits.work_height_m
    least, _, most = traits.reach_m
    return (away >= least) & (away <= most) & (height >= low) & (height <= high)


def describe_target(bundle: SceneBundle, item: BundleObject, solids: list[ConvexSolid]) -> Target:
    """Measure an object as something to pick up (without regard to any robot)."""
    cloud = np.concatenate([s.vertices for s in solids if s.owner == item.id])
    angles = np.arange(36) * np.pi / 36
    along = cloud[:, :2] @ np.stack([np.cos(angles), np.sin(angles)])
    widths = along.max(axis=0) - along.min(axis=0)
    low, high = cloud.min(axis=0), cloud.max(axis=0)
    loaded = any(e.parent == item.id for e in bundle.edges)
    problem = "" if not loaded else "something stands on it or hangs from it"
    narrow = int(np.argmin(widths))
    return Target(
        item.id,
        item.label,
        (low + high) / 2,
        low[2],
        high[2],
        float(widths[narrow]),
        float(angles[narrow]),
        problem,
    )


def candidate_targets(
    bundle: SceneBundle,
    solids: list[ConvexSolid],
    movable: set[int],
    traits: RobotTraits,
    config: PlacementConfig,
) -> list[Target]:
    """Return the movable objects, best to pick up first; those with a problem come last."""
    scored = []
    entries = {entry["id"]: entry for entry in bundle.scene["objects"]}
    for item in bundle.objects:
        if item.id not in movable:
            continue
        target = describe_target(bundle, item, solids)
        problems = [target.problem] if target.problem else []
        opening = traits.gripper_opening_m - config.grip_margin_m
        if target.grip_width_m > opening:
            problems.append(
                f"{100 * target.grip_width_m:.1f} cm wide, the gripper takes {100 * opening:.1f} cm"
            )
        if item.mass_kg > min(config.max_grip_mass_kg, traits.payload_kg):
            problems.append(f"weighs {item.mass_kg:.1f} kg")
        if target.top_m - target.bottom_m < config.min_height_m:
            problems.append(f"only {1000 * (target.top_m - target.bottom_m):.0f} mm high")
        buried = _buried_share(target, solids)
        if buried > 0.25:
            problems.append("other things are close above or beside it")
        if not entries[item.id].get("assembly", {}).get("stable", True):
            problems.append("does not stand by itself")
        # Prefer what fits well into the gripper, stands free, and was well seen.
        score = abs(target.grip_width_m - 0.55 * traits.gripper_opening_m) / traits.gripper_opening_m + buried
        score += 1.0 - float(entries[item.id]["provenance"].get("observed_fraction", 1.0))
        described = Target(**{**vars(target), "problem": "; ".join(problems)})
        scored.append((len(problems), score, item.id, described))
    return [entry[-1] for entry in sorted(scored, key=lambda entry: entry[:3])]


def choose_targets(candidates: list[Target], wanted: str | int, bundle: SceneBundle) -> list[Target]:
    """Return the candidates that `wanted` means, in order: "auto", an id (number or text) or a label.

    Raises:
        UsageError: names what could be picked up.
    """
    if wanted == "auto":
        return candidates
    text = str(wanted).strip()
    by_id = [t for t in candidates if str(t.id) == text]
    found = by_id or [t for t in candidates if t.label.lower() == text.lower()]
    if found:
        return found
    listed = ", ".join(f"{t.id} ({t.label})" for t in candidates) or "none"
    still = [o for o in bundle.objects if str(o.id) == text or o.label.lower() == text.lower()]
    why = f"object {still[0].id} ({still[0].label}) cannot move" if still else "there is no such object"
    raise UsageError(
        f"scene {bundle.scene['id']}: target {wanted!r}: {why}. Movable objects (id and label): {listed}"
    )


def place_robot(
    solids: list[ConvexSolid],
    floor_ids: set[int],
    wall_ids: set[int],
    targets: list[Target],
    shape: RobotShape,
    traits: RobotTraits,
    config: PlacementConfig,
    interests: list[np.ndarray] | None = None,
) -> Placement:
    """Find where the robot stands free and reaches a target; the earlier targets are preferred.

    Where none can be reached, the robot stands free as near as can be, and the placement's note says so.

    Args:
        solids: Everything in the scene.
        floor_ids: Which of them are floors.
        wall_ids: Which of them are walls.
        targets: What to reach, the best first.
        shape: The robot at rest.
        traits: What the robot can do.
        config: How the place is searched.
        interests: Places (k, 3) each; of every array one must be within reach, too.
    """
    upright = [s for s in solids if s.owner not in floor_ids]
    clean = [t for t in targets if not t.problem]
    for group in (clean, [t for t in targets if t.problem]):
        for target in group:
            placement = _place_near(upright, wall_ids, target, shape, traits, config, interests or [])
            if placement is not None:
                return placement
    return _place_anywhere(upright, targets[0] if targets else None, shape, traits, config)


def _place_near(
    solids: list[ConvexSolid],
    wall_ids: set[int],
    target: Target,
    shape: RobotShape,
    traits: RobotTraits,
    config: PlacementConfig,
    interests: list[np.ndarray],
) -> Placement | None:
    reach = traits.reach_m[2] + 1.2
    lower = np.array([*(target.center[:2] - reach), -0.1])
    upper = np.array([*(target.center[:2] + reach), max(target.top_m + 1.0, 2.0)])
    solids = [s for s in solids if (s.lower <= upper).all() and (s.upper >= lower).all()]
    grid = OccupancyGrid(solids, lower, upper, margin_m=config.clearance_m)
    walls = OccupancyGrid([s for s in solids if s.owner in wall_ids], lower, upper, margin_m=0.0)
    others = OccupancyGrid([s for s in solids if s.owner != target.id], lower, upper, margin_m=0.0)
    if traits.mobile:
        low, high = traits.work_height_m
        if not low - 0.3 <= target.center[2] <= high:
            return None
        heights = [0.0]
    else:
        heights = [max(target.bottom_m, 0.0)]
        for goals in interests:
            # Between two heights, where one of them is too far up or down from the other.
            between = (target.bottom_m + float(np.median(goals[:, 2]))) / 2
            if abs(between - target.bottom_m) > 0.1:
                heights.append(max(between, 0.0))
    for position, yaw in _ring(target, heights, traits, config, others):
        placement = Placement(position, yaw, 0.0, target, "")
        if not all(placement.reaches(goals, traits).any() for goals in interests):
            continue
        if not _sees_over_walls(walls, placement, target):
            continue
        pedestal = _stands(grid, solids, placement, shape, traits, config)
        if pedestal is not None:
            return Placement(position, yaw, pedestal, target, "")
    return None


def _ring(
    target: Target, heights: list[float], traits: RobotTraits, config: PlacementConfig, others: OccupancyGrid
) -> list[tuple[np.ndarray, float]]:
    """Return (root position (3,), yaw) of all candidates around a target, best first."""
    least, best, most = traits.reach_m
    ranked = []
    for height in heights:
        for radius in np.linspace(least, most, config.radii):
            for direction in range(config.directions):
                angle = 2 * np.pi * direction / config.directions
                outward = np.array([np.cos(angle), np.sin(angle)])
                position = np.array([*(target.center[:2] + radius * outward), height])
                # The hand comes from the robot's side, above the target: that way should be free.
                along = np.linspace(0.06, radius, 12)
                way = np.array(
                    [[*(target.center[:2] + a * outward), target.top_m + 0.10 + 0.3 * a] for a in along]
                )
                blocked = float(others.occupied(way).mean())
                ranked.append(
                    (abs(radius - best) / (most - least) + 2.0 * blocked, direction, position, angle + np.pi)
                )
    ranked.sort(key=lambda entry: (round(entry[0], 6), entry[1]))
    return [(position, yaw) for _, _, position, yaw in ranked]


def _sees_over_walls(walls: OccupancyGrid, placement: Placement, target: Target) -> bool:
    """Tell whether no wall is between the robot and the target, so that both are in the same room."""
    shares = np.linspace(0, 1, 40)[:, None]
    for lift in (0.1, 0.5):
        start = placement.position + np.array([0, 0, lift])
        if walls.occupied(start + shares * (target.center + np.array([0, 0, 0.05]) - start)).any():
            return False
    return True


def _stands(
    grid: OccupancyGrid,
    solids: list[ConvexSolid],
    placement: Placement,
    shape: RobotShape,
    traits: RobotTraits,
    config: PlacementConfig,
) -> float | None:
    """Return the height of the pedestal under a robot that stands free there, or None where it does not."""
    points = shape.points
    below, floor = placement.position[2], 0.0
    if not traits.mobile:
        disk = _disk(traits.footprint_radius_m)
        column = np.arange(0.03, max(below - 0.03, 0.03), 0.04)
        free = not grid.occupied(placement.to_world(disk[None] - [0, 0, 1] * column[:, None, None])).any()
        if not free:
            top = _support_top(solids, placement.to_world(disk), below)
            if top is None:
                return None
            # It stands on the support: what is below 5 cm is its foot, which touches on purpose.
            floor = top
            points = points[points[:, 2] > 0.05]
            foot = placement.to_world(disk + np.array([0, 0, 0.05]))
            if grid.occupied(foot).any():
                return None
    world = placement.to_world(points)
    # The grid leaves out the floor; a mobile robot's wheels touch it on purpose.
    if grid.occupied(world).any() or (not traits.mobile and (world[:, 2] < -0.005).any()):
        return None
    return max(below - floor, 0.0)


def _disk(radius: float) -> np.ndarray:
    """Return points (n, 3) that cover a disk at z = 0, no farther apart than 3 cm."""
    axis = np.arange(-radius, radius + 1e-9, radius / max(int(np.ceil(radius / 0.03)), 1))
    x, y = np.meshgrid(axis, axis)
    inside = x**2 + y**2 <= radius**2 + 1e-9
    return np.stack([x[inside], y[inside], np.zeros(inside.sum())], axis=1)


def _support_top(solids: list[ConvexSolid], disk: np.ndarray, height: float) -> float | None:
    """Return the height of the level surface just below `height` that carries all of the disk (n, 3), or
    None.
    """
    carried = np.zeros(len(disk), bool)
    tops = []
    for solid in solids:
        if not height - 0.03 <= solid.upper[2] <= height + 0.01:
            continue
        probe = np.column_stack([disk[:, :2], np.full(len(disk), solid.upper[2] - 0.004)])
        inside = (probe @ solid.half_spaces[:, :3].T + solid.half_spaces[:, 3] <= 1e-6).all(axis=1)
        if inside.any():
            carried |= inside
            tops.append(solid.upper[2])
    return max(tops) if tops and carried.all() else None


def _buried_share(target: Target, solids: list[ConvexSolid]) -> float:
    """Return which share of the space that a gripper needs around and above the target is filled."""
    lower, upper = target.center - 0.3, np.array([*(target.center[:2] + 0.3), target.top_m + 0.3])
    # What it stands on is below it, and no obstacle: the cells' size would make it one for low things.
    others = [s for s in solids if s.owner != target.id and s.upper[2] > target.bottom_m + 0.01]
    grid = OccupancyGrid(others, lower, upper, margin_m=0.0)
    heights = np.linspace(target.top_m + 0.03, target.top_m + 0.22, 6)
    disk = _disk(0.05)
    above = np.array([[*(target.center[:2] + p[:2]), z] for z in heights for p in disk])
    side = np.array([np.cos(target.grip_yaw_rad), np.sin(target.grip_yaw_rad)])
    grip = max(target.center[2], target.top_m - 0.03)
    reach = target.grip_width_m / 2 + 0.03
    fingers = np.array(
        [[*(target.center[:2] + s * reach * side), z] for s in (-1, 1) for z in (grip, target.top_m)]
    )
    return float(np.maximum(grid.occupied(above).mean(), grid.occupied(fingers).mean()))


def _place_anywhere(
    solids: list[ConvexSolid],
    target: Target | None,
    shape: RobotShape,
    traits: RobotTraits,
    config: PlacementConfig,
) -> Placement:
    """Stand free as near to the target (or the middle of the scene) as can be, on the floor."""
    lower = np.min([s.lower for s in solids], axis=0) if solids else np.zeros(3)
    upper = np.max([s.upper for s in solids], axis=0) if solids else np.zeros(3)
    goal = target.center if target is not None else (lower + upper) / 2
    lower, upper = np.minimum(lower, 0) - 1.0, np.maximum(upper, 2.0) + 1.0
    grid = OccupancyGrid(solids, lower, upper, cell_m=0.04, margin_m=config.clearance_m)
    note = "" if target is None else f"the robot cannot reach object {target.id} ({target.label})"
    reach = float(np.linalg.norm((upper - lower)[:2])) + 1.0
    for radius in np.arange(traits.reach_m[1], reach + 0.3, 0.15):
        for direction in range(24):
            angle = 2 * np.pi * direction / 24
            position = np.array([goal[0] + radius * np.cos(angle), goal[1] + radius * np.sin(angle), 0.0])
            placement = Placement(position, angle + np.pi, 0.0, target, note)
            if not grid.occupied(placement.to_world(shape.points)).any():
                return placement
    # Outside the box of everything nothing is filled, and the last circle lies outside.
    raise AssertionError("no free place, not even outside the scene")
