"""`SceneFacts`: names, sizes, supports, free space of a scene, from its bundle alone. NumPy only."""

import copy
import functools
import re
from collections import OrderedDict

import numpy as np

from registry import SceneBundle
from registry.labels import STRUCTURE
from registry.rigid_groups import moving_ids, welded_to
from simrecon_envs.hovering import Hover, most_room
from simrecon_envs.occupancy import ConvexSolid, scene_solids
from simrecon_envs.placement import PlacementConfig, Target, candidate_targets
from simrecon_envs.robots import RobotTraits, robot_shape, traits_of
from simrecon_envs.standing import Places
from simrecon_envs.surfaces import Container, find_container, free_spots

_FOOT_M = 0.012  # vertices up to this height above the bottom belong to the foot


class SceneFacts:
    """Facts of a bundle for the tasks of one robot; expensive properties are computed on first use.

    Objects are named by their id in the bundle. Positions are in world space, as captured.
    """

    def __init__(self, bundle: SceneBundle, robot: str) -> None:
        """Read the scene graph and measure the movable objects."""
        self.bundle = bundle
        self.scene_id: str = bundle.scene["id"]
        self.solids: list[ConvexSolid] = scene_solids(bundle)
        self.robot = robot
        self.traits: RobotTraits = traits_of(robot)
        self.movable = sorted(moving_ids(bundle) - welded_to(bundle).keys())
        self.parent = {edge.child: edge.parent for edge in bundle.edges}
        self.relation = {edge.child: edge.relation for edge in bundle.edges}
        self.labels = {item.id: item.label for item in (*bundle.base, *bundle.objects)}
        self.phrases = {item.id: item.name for item in bundle.objects}
        self.base_ids = {item.id for item in bundle.base}
        self.floor_ids = {item.id for item in bundle.base if item.label == "floor"}
        self.wall_ids = {item.id for item in bundle.base if item.label == "wall"}
        self.mass_kg = {item.id: item.mass_kg for item in bundle.objects}
        self.ranked: list[Target] = candidate_targets(
            bundle, self.solids, set(self.movable), self.traits, PlacementConfig()
        )
        self.targets = {target.id: target for target in self.ranked}
        self.names = _names(bundle)
        self.listed: dict[str, list] = {}  # cache of `catalog`, by kind
        self._containers: dict[int, Container | None] = {}
        self._spots: dict[tuple, np.ndarray] = {}
        self._hovers: dict[tuple[int, float], Hover] = {}

    @functools.cached_property
    def places(self) -> Places:
        """Return the search for a placement of the robot."""
        shape = robot_shape(self.robot)
        return Places(self.solids, self.floor_ids, self.wall_ids, shape, self.traits, PlacementConfig())

    @functools.cached_property
    def carriers(self) -> list[int]:
        """Return the ids of supports: what carries an object, or looks wide enough to; no walls."""
        carrying = {p for c, p in self.parent.items() if self.relation[c] == "supported_by"}
        wide = {t.id for t in self.ranked if t.grip_width_m >= 0.08}
        wide |= {o.id for o in self.bundle.objects if not self.hangs(o.id) and min(o.scale[:2]) >= 0.15}
        return sorted(key for key in carrying | wide if key not in self.wall_ids)

    def container(self, key: int) -> Container | None:
        """Return the inside of a container; None for an object without one, or one with objects stacked in it."""
        if key not in self._containers:
            self._containers[key] = find_container(self.solids, key)
        return self._containers[key]

    @functools.cached_property
    def containers(self) -> list[int]:
        """Return the ids of the containers."""
        return [o.id for o in self.bundle.objects if not self.hangs(o.id) and self.container(o.id)]

    def hangs(self, key: int) -> bool:
        """Return whether an object is attached to another."""
        return self.relation.get(key) == "attached_to"

    def radius_m(self, key: int) -> float:
        """Return the horizontal radius of a movable object around its box center."""
        cloud = np.concatenate([s.vertices[:, :2] for s in self.solids if s.owner == key])
        return float(np.linalg.norm(cloud - self.targets[key].center[:2], axis=1).max())

    def foot_width_m(self, key: int) -> float:
        """Return the least horizontal width of a movable object's foot."""
        cloud = np.concatenate([s.vertices for s in self.solids if s.owner == key])
        foot = cloud[cloud[:, 2] <= self.targets[key].bottom_m + _FOOT_M, :2]
        angles = np.arange(36) * np.pi / 36
        return float(np.ptp(foot @ np.stack([np.cos(angles), np.sin(angles)]), axis=0).min())

    def height_m(self, key: int) -> float:
        """Return the height of a movable object."""
        return self.targets[key].top_m - self.targets[key].bottom_m

    def hand_over(self, key: int, bottoms: np.ndarray) -> np.ndarray:
        """Return the hand positions (k, 3) that hold a movable object whose bottom is at `bottoms` (k, 3)."""
        target = self.targets[key]
        lift = target.grasps[0].offset[2] if target.grasps else 0.0
        return bottoms + np.array([0, 0, self.height_m(key) / 2 + lift])

    def hover(self, key: int, above_m: float) -> Hover:
        """Return the turn and the room of a closed hand at a height above a movable object's top."""
        if (key, above_m) not in self._hovers:
            target = self.targets[key]
            tip = np.array([*target.center[:2], target.top_m + above_m])
            self._hovers[key, above_m] = most_room(self.solids, tip, self.traits.hand)
        return self._hovers[key, above_m]

    def spots(self, support: int, subject: int) -> np.ndarray:
        """Return free positions (k, 3) on a support for the bottom of the subject's box, the roomiest first."""
        key = (support, subject)
        if key not in self._spots:
            around = self.targets[subject].center[:2] if support in self.base_ids else None
            radius = 0.9 * self.radius_m(subject)
            self._spots[key] = free_spots(
                self.solids, support, radius, frozenset({subject, *self.above(subject)}), around
            )
        return self._spots[key]

    def above(self, key: int) -> list[int]:
        """Return the ids of all descendants of an object in the scene graph."""
        out = [child for child, parent in self.parent.items() if parent == key]
        return out + [far for child in out for far in self.above(child)]

    def thing(self, key: int) -> str:
        """Return an object's name in a sentence: its phrase ("small red box"), its label ("mug"), or "object 7"."""
        if self.phrases.get(key):
            return self.phrases[key]
        label = self.labels[key]
        same = [other for other in self.labels.values() if other == label]
        if label == "unknown":
            return f"object {key}"
        return label if len(same) == 1 or key in self.floor_ids else f"{label} {key}"


_known: OrderedDict[tuple[str, str, str], SceneFacts] = OrderedDict()
_KEPT = 8


def scene_facts(bundle: SceneBundle, robot: str) -> SceneFacts:
    """Return the facts of a scene for a robot, from a cache of the 8 last used."""
    key = (str(bundle.root), bundle.revision, robot)
    if key not in _known:
        # A copy holds no lease on the folder; it reads no file later.
        _known[key] = SceneFacts(copy.copy(bundle), robot)
    _known.move_to_end(key)
    while len(_known) > _KEPT:
        _known.popitem(last=False)
    return _known[key]


def _names(bundle: SceneBundle) -> dict[str, int]:
    """Return {name: id} of floors, structure and objects: `mug` where the label is unique, `box_7`, `object_7`."""
    names: dict[str, int] = {}
    items = [*(b for b in bundle.base if b.label in ("floor", STRUCTURE)), *bundle.objects]
    slugs = [re.sub(r"[^a-z0-9]+", "_", item.label.lower()).strip("_") for item in items]
    for item, slug in zip(items, slugs, strict=True):
        if slug and slug != "unknown" and (slugs.count(slug) == 1 or item in bundle.base):
            names.setdefault(slug, item.id)
        if slug and slug != "unknown":
            names[f"{slug}_{item.id}"] = item.id
        names[f"object_{item.id}"] = item.id
    return names


def best_name(facts: SceneFacts, key: int) -> str:
    """Return the shortest name of an object, one with its label if there is any."""
    mine = [name for name, value in facts.names.items() if value == key]
    return min(mine, key=lambda name: (name.startswith("object_"), len(name)))
