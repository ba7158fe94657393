"""Rank the objects that a robot can pick up; types of targets and robot placements. NumPy and SciPy only."""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from registry import SceneBundle, UsageError
from registry.bundle import BundleObject
from registry.geometry import transform_points
from simrecon_envs.grasps import Grasp, find_grasps
from simrecon_envs.kept_grasps import KeptGrasps
from simrecon_envs.occupancy import ConvexSolid
from simrecon_envs.robots import RobotTraits


@dataclass(frozen=True)
class PlacementConfig:
    """Parameters of the search for the robot's place and target."""

    directions: int = 36
    """Number of directions around the target."""
    radii: int = 9
    """Number of distances between minimum and maximum reach."""
    clearance_m: float = 0.015
    """Minimum distance of the robot at rest from all solids."""
    max_grip_mass_kg: float = 2.0
    """Maximum mass of a target."""
    min_height_m: float = 0.02
    """Minimum height of an object that can be gripped from above."""


@dataclass(frozen=True)
class Target:
    """An object to pick up, in world space at its captured pose."""

    id: int
    label: str
    center: np.ndarray  # float64 (3,) of its bounding box
    bottom_m: float
    top_m: float
    grip_width_m: float  # minimum horizontal width
    grip_yaw_rad: float  # direction of that width
    problem: str  # reason why it can hardly be picked up, or ""
    grasps: tuple[Grasp, ...] = ()  # best first


@dataclass(frozen=True)
class Placement:
    """Place of the robot: `world_from_root`, upright."""

    position: np.ndarray  # float64 (3,)
    yaw_rad: float
    pedestal_m: float  # height of the pedestal below it; 0 for none
    target: Target | None
    note: str  # problem of this place, or ""

    @property
    def quat_wxyz(self) -> np.ndarray:
        """Return its orientation as quaternion wxyz (4,)."""
        return np.array([np.cos(self.yaw_rad / 2), 0, 0, np.sin(self.yaw_rad / 2)])

    def to_world(self, points: np.ndarray) -> np.ndarray:
        """Transform points (..., 3) from root to world space."""
        c, s = np.cos(self.yaw_rad), np.sin(self.yaw_rad)
        return points @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + self.position

    def to_root(self, points: np.ndarray) -> np.ndarray:
        """Transform points (..., 3) from world to root space."""
        c, s = np.cos(self.yaw_rad), np.sin(self.yaw_rad)
        return (points - self.position) @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])

    def reaches(self, points: np.ndarray, traits: RobotTraits) -> np.ndarray:
        """Return whether world points (n, 3) are within reach (n,)."""
        return within_reach(self.position, np.array(self.yaw_rad), points, traits)


def within_reach(root: np.ndarray, yaw: np.ndarray, points: np.ndarray, traits: RobotTraits) -> np.ndarray:
    """Return whether points (..., 3) are within reach of a robot at `root` (..., 3) with `yaw` (...) (rad).

    The reach is a ring about the root, limited to a sector in front of the robot and to its working heights.
    """
    away = np.linalg.norm(points[..., :2] - root[..., :2], axis=-1)
    height = points[..., 2] - root[..., 2]
    low, high = traits.work_height_m
    least, _, most = traits.reach_m
    way = points[..., :2] - root[..., :2]
    ahead = np.cos(yaw) * way[..., 0] + np.sin(yaw) * way[..., 1] >= np.cos(traits.aside_rad) * away - 1e-9
    return (away >= least) & (away <= most) & (height >= low) & (height <= high) & ahead


def describe_target(bundle: SceneBundle, item: BundleObject, solids: list[ConvexSolid]) -> Target:
    """Measure the box, width and load of an object to pick up; independent of the robot."""
    cloud = np.concatenate([s.vertices for s in solids if s.owner == item.id])
    angles = np.arange(36) * np.pi / 36
    along = cloud[:, :2] @ np.stack([np.cos(angles), np.sin(angles)])
    widths = along.max(axis=0) - along.min(axis=0)
    low, high = cloud.min(axis=0), cloud.max(axis=0)
    loaded = any(e.parent == item.id for e in bundle.edges)
    problem = "" if not loaded else "something stands on it or hangs from it"
    narrow = int(np.argmin(widths))
    width, yaw = float(widths[narrow]), float(angles[narrow])
    return Target(item.id, item.label, (low + high) / 2, low[2], high[2], width, yaw, problem)


def candidate_targets(
    bundle: SceneBundle,
    solids: list[ConvexSolid],
    movable: set[int],
    traits: RobotTraits,
    config: PlacementConfig,
) -> list[Target]:
    """Return the movable objects with their grasps, best first; those with a problem come last."""
    scored: list[tuple[int, float, int, Target]] = []
    entries = {entry["id"]: entry for entry in bundle.scene["objects"]}
    kept = KeptGrasps(bundle.revision, traits.hand)
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
            search = partial(
                find_grasps, solids, item.id, target.center, item.mass_kg, center_of_mass, traits.hand
            )
            grasps = kept.of(item.id, search)
            if not grasps:
                problems.append(_why_no_grasp(target, traits))
        if target.top_m - target.bottom_m < config.min_height_m:
            problems.append(f"only {1000 * (target.top_m - target.bottom_m):.0f} mm high")
        if not entries[item.id].get("assembly", {}).get("stable", True):
            problems.append("does not stand by itself")
        # Prefer low grasp costs and a large observed share of the surface.
        score = grasps[0].cost if grasps else target.grip_width_m
        score += 1.0 - float(entries[item.id]["provenance"].get("observed_fraction", 1.0))
        described = replace(target, problem="; ".join(problems), grasps=tuple(grasps))
        scored.append((len(problems), score, item.id, described))
    kept.save()
    return [entry[-1] for entry in sorted(scored, key=lambda entry: entry[:3])]


def choose_targets(candidates: list[Target], wanted: str | int, bundle: SceneBundle) -> list[Target]:
    """Return the candidates that match `wanted`: "auto" (all), an id (int or text) or a label.

    Raises:
        UsageError: No candidate matches; lists the movable objects.
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
