"""What can be picked up, and what a robot's place is: bundle + robot -> targets. NumPy and SciPy only."""

from dataclasses import dataclass, replace

import numpy as np

from registry import SceneBundle, UsageError
from registry.bundle import BundleObject
from registry.geometry import transform_points
from simrecon_envs.grasps import Grasp, find_grasps
from simrecon_envs.occupancy import ConvexSolid
from simrecon_envs.robots import RobotTraits


@dataclass(frozen=True)
class PlacementConfig:
    """How the robot's place is searched."""

    directions: int = 36
    """How many directions around the target are tried."""
    radii: int = 9
    """How many distances between the least and the greatest reach are tried."""
    clearance_m: float = 0.015
    """Least distance of the robot at rest from everything."""
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
    grasps: tuple[Grasp, ...] = ()  # the best first


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

    def to_root(self, points: np.ndarray) -> np.ndarray:
        """Take points (..., 3) from world to root space."""
        c, s = np.cos(self.yaw_rad), np.sin(self.yaw_rad)
        return (points - self.position) @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])

    def reaches(self, points: np.ndarray, traits: RobotTraits) -> np.ndarray:
        """Return which world points (n, 3) are within the hand's reach (n,)."""
        return within_reach(self.position, np.array(self.yaw_rad), points, traits)


def within_reach(root: np.ndarray, yaw: np.ndarray, points: np.ndarray, traits: RobotTraits) -> np.ndarray:
    """Return which points (..., 3) a robot reaches whose root is at (..., 3), turned by yaw (...).

    They are in a ring about it, before it, and at heights that it works at.
    """
    away = np.linalg.norm(points[..., :2] - root[..., :2], axis=-1)
    height = points[..., 2] - root[..., 2]
    low, high = traits.work_height_m
    least, _, most = traits.reach_m
    way = points[..., :2] - root[..., :2]
    ahead = np.cos(yaw) * way[..., 0] + np.sin(yaw) * way[..., 1] >= np.cos(traits.aside_rad) * away - 1e-9
    return (away >= least) & (away <= most) & (height >= low) & (height <= high) & ahead


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
        grasps: list[Grasp] = []
        if item.mass_kg > min(config.max_grip_mass_kg, traits.payload_kg):
            problems.append(f"weighs {item.mass_kg:.1f} kg")
        elif not problems:
            center_of_mass = transform_points(item.world_from_object, item.center_of_mass[None])[0]
            grasps = find_grasps(solids, item.id, target.center, item.mass_kg, center_of_mass, traits.hand)
            if not grasps:
                problems.append(_why_no_grasp(target, traits))
        if target.top_m - target.bottom_m < config.min_height_m:
            problems.append(f"only {1000 * (target.top_m - target.bottom_m):.0f} mm high")
        if not entries[item.id].get("assembly", {}).get("stable", True):
            problems.append("does not stand by itself")
        # Prefer what can be gripped well, and was well seen.
        score = grasps[0].cost if grasps else target.grip_width_m
        score += 1.0 - float(entries[item.id]["provenance"].get("observed_fraction", 1.0))
        described = replace(target, problem="; ".join(problems), grasps=tuple(grasps))
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


def _why_no_grasp(target: Target, traits: RobotTraits) -> str:
    takes = 100 * traits.hand.opening_m
    if target.grip_width_m > traits.hand.opening_m:
        return f"{100 * target.grip_width_m:.1f} cm wide, and no part of it fits into the gripper ({takes:.0f} cm)"
    return "there is no room for the gripper around it"
