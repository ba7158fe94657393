"""Simulator state for tasks, cached per control step; b environments, n movable objects.

Many environments on a GPU are read as tensors from ManiSkill's structs. One environment on the CPU is read as NumPy
arrays directly from SAPIEN (`cpu_env`), because the structs and tensors cost more than the physics.
"""

import math
from collections.abc import Callable, Hashable
from typing import Any

import numpy as np
import torch

from registry.geometry import invert_rigid, transform_points
from simrecon_envs.arrays import Array, atan2, component, largest, norm, rotate
from simrecon_envs.cpu_env import DirectReads

_GRASP_REACH_M = 0.12  # a held object is nearer to the hand than this plus its radius
_GRAVITY_M_S2 = 9.81


class Measures:
    """Poses, velocities and contacts of the movable objects and of the robot."""

    def __init__(self, env: Any, direct: bool | None = None) -> None:
        """Collect the bodies.

        Args:
            env: A built `SceneEnv`.
            direct: Read directly from SAPIEN, as NumPy arrays; None: if the simulation runs on the CPU.
        """
        self._env = env
        direct = not env.gpu_sim_enabled if direct is None else direct
        self._actors = [placed.actor for placed in env.builder.movable_actors]
        self._row: dict[int, int] = {}
        centers = np.zeros((len(self._actors), 3))
        self._half_diagonal: dict[int, float] = {}
        self._nominal_n: dict[int, float] = {}
        self._weight_n: dict[int, Array] = {}
        for number, placed in enumerate(env.builder.movable_actors):
            self._row[placed.id] = number
            target = env.facts.targets[placed.id]
            item = next(o for o in env.bundle.objects if o.id == placed.id)
            actor_from_world = placed.actor_from_object @ invert_rigid(item.world_from_object)
            centers[number] = transform_points(actor_from_world, target.center[None])[0]
            cloud = np.concatenate([s.vertices for s in env.facts.solids if s.owner == placed.id])
            self._half_diagonal[placed.id] = float(np.linalg.norm(cloud - target.center, axis=1).max())
            self._nominal_n[placed.id] = item.mass_kg * _GRAVITY_M_S2
        self._direct = DirectReads(env, self._actors, centers) if direct else None
        for key, weight in self._nominal_n.items():
            self._weight_n[key] = self.array(np.full((env.num_envs, 1), weight))
        self._centers = self.array(centers)[None]
        self._supported: dict[tuple[int, int], Array] = {}
        self._cache: dict[Any, Array] = {}
        self._placed: dict[Hashable, Any] = {}
        self._keys = list(self._row)
        self._about: dict[int, set[Hashable]] = {
            key: set() for key in self._row
        }  # keys of `_placed` by object
        self._spots: dict[int, list[float]] = {}
        self._axes: dict[tuple[int, int], np.ndarray] = {}

    def array(self, numbers: np.ndarray) -> Array:
        """Convert to float32, as NumPy array or tensor on the device."""
        if self._direct is not None:
            return np.array(numbers, np.float32)
        return torch.as_tensor(numbers, dtype=torch.float32, device=self._env.device)

    def refresh(self) -> None:
        """Clear cached values after a simulation step."""
        self._cache = {}
        moved = range(len(self._actors)) if self._direct is None else self._direct.refresh()
        for row in moved:
            key = self._keys[row]
            self._spots.pop(key, None)
            for name in self._about[key]:
                self._placed.pop(name, None)
            self._about[key].clear()

    def while_still(self, name: Hashable, keys: tuple[int, ...], compute: Callable[[], Any]) -> Any:
        """Return `compute()`, cached until one of the objects `keys` moves (most objects do not move).

        The result may only depend on their poses and on values that are constant in an episode.
        """
        known = self._placed.get(name)
        if known is None:
            known = self._placed[name] = compute()
            for key in keys:
                self._about[key].add(name)
        return known

    def forget(self, env_idx: torch.Tensor) -> None:
        """Clear all cached values, and the known supports in the environments `env_idx` that are reset."""
        if self._direct is not None:
            self._direct.find()
            self._supported = {}
        self.refresh()
        self._placed, self._spots = {}, {}
        for known in self._supported.values():
            known[env_idx] = False

    def scale_weight(self, key: int, env_idx: torch.Tensor, factor: torch.Tensor) -> None:
        """Set the weight of an object to that of the bundle times a factor (len(env_idx),)."""
        self._weight_n[key][env_idx, 0] = self._nominal_n[key] * factor

    # ---- Objects.

    @property
    def poses(self) -> Array:
        """Return the actor poses (b, n, 7), world: position (m), quaternion wxyz."""
        if "poses" not in self._cache:
            if self._direct is not None:
                self._cache["poses"] = self._direct.poses
            else:
                self._cache["poses"] = torch.stack([a.pose.raw_pose for a in self._actors], dim=1)
        return self._cache["poses"]

    def position(self, key: int) -> Array:
        """Return the box centre (b, 3) of an object, world."""
        return self.while_still(("position", key), (key,), lambda: self.pose(key)[:, :3])

    def pose(self, key: int) -> Array:
        """Return the pose (b, 7) of an object's box centre, with the orientation of its actor."""
        return self.while_still(("pose", key), (key,), lambda: self._pose(self._row[key]))

    def _pose(self, row: int) -> Array:
        if self._direct is not None:
            return self._direct.pose(row)
        pose = self.poses[:, row]
        center = pose[:, :3] + rotate(pose[:, 3:], self._centers[:, row])
        return torch.cat([center, pose[:, 3:]], dim=1)

    def up(self, key: int) -> Array:
        """Return the cosine (b,) of an object's tilt from its captured orientation."""
        return self.while_still(("up", key), (key,), lambda: component(self._turned(key, 2), 2))

    def yaw(self, key: int) -> Array:
        """Return the rotation (b,) (rad) of an object about +z from its captured orientation."""
        return self.while_still(("yaw", key), (key,), lambda: self._yaw(key))

    def _yaw(self, key: int) -> Array:
        side = self._turned(key, 0)
        return atan2(component(side, 1), component(side, 0))

    def speeds(self, key: int) -> tuple[Array, Array]:
        """Return the linear (m/s) and angular (rad/s) speed (b,) of an object."""
        name = ("speed", key)
        if name not in self._cache:
            if self._direct is not None:
                self._cache[name] = self._direct.speeds(self._row[key])
            else:
                actor = self._actors[self._row[key]]
                self._cache[name] = norm(actor.linear_velocity), norm(actor.angular_velocity)
        return self._cache[name]

    def at_rest(self, key: int, linear_m_s: float = 0.05, angular_rad_s: float = 0.6) -> Array:
        """Return whether the speeds of an object are at most these (b,)."""
        linear, angular = self.speeds(key)
        return (linear <= linear_m_s) & (angular <= angular_rad_s)

    # ---- The robot.

    @property
    def tcp(self) -> Array:
        """Return the pose (b, 7) of the tool centre point (between the fingertips)."""
        if self._direct is not None:
            return self._direct.tcp
        if "tcp" not in self._cache:
            self._cache["tcp"] = self.link_pose(self._env.agent.tcp)
        return self._cache["tcp"]

    @property
    def tip(self) -> Array:
        """Return the position (b, 3) of the tool centre point."""
        if "tip" not in self._cache:
            self._cache["tip"] = self.tcp[:, :3]
        return self._cache["tip"]

    def tcp_distance(self, key: int) -> Array:
        """Return the distance (b,) of the tool centre point from an object's box centre."""
        name = ("tcp_distance", key)
        if name not in self._cache:
            if self._direct is None:
                self._cache[name] = norm(self.position(key) - self.tcp[:, :3])
            else:
                if key not in self._spots:
                    self._spots[key] = self.position(key)[0].tolist()
                self._cache[name] = np.float32(math.dist(self._spots[key], self._direct.tip()))
        return self._cache[name]

    @property
    def joint_speed(self) -> Array:
        """Return the speed (b,) of the robot's fastest joint, without the fingers."""
        if "joint_speed" not in self._cache:
            if self._direct is not None:
                self._cache["joint_speed"] = self._direct.joint_speed()
            else:
                qvel = self.qvel
                keep = qvel.shape[1] - 2 if qvel.shape[1] > 2 else qvel.shape[1]
                self._cache["joint_speed"] = largest(abs(qvel[:, :keep]))
        return self._cache["joint_speed"]

    @property
    def qvel(self) -> Array:
        """Return the joint velocities (b, d) of the robot (rad/s, m/s)."""
        return self._env.agent.robot.get_qvel() if self._direct is None else self._direct.qvel()

    def link_pose(self, link: Any) -> Array:
        """Return the pose (b, 7) of a link of the robot."""
        return link.pose.raw_pose if self._direct is None else self._direct.link_pose(link)

    def _near_hand(self, key: int) -> Array:
        """Return whether the hand is close enough to hold an object (b,)."""
        return self.tcp_distance(key) <= self._half_diagonal[key] + _GRASP_REACH_M

    def undisturbed(
        self, name: Hashable, subject: int, keys: tuple[int, ...], compute: Callable[[], Any]
    ) -> Any:
        """Return `compute()`, cached while the objects `keys` sleep and the hand is too far to hold the subject.

        The result must not depend on anything else that changes meanwhile. Tensors are never cached.
        """
        bodies = () if self._direct is None else self._direct.bodies
        if bodies and not self._near_hand(subject) and all(bodies[self._row[k]].is_sleeping for k in keys):
            return self.while_still(name, keys, compute)
        self._placed.pop(name, None)
        return compute()

    def held(self, key: int) -> Array:
        """Return whether the robot grasps an object (b,)."""
        name = ("held", key)
        if name not in self._cache:
            near, row = self._near_hand(key), self._row[key]
            if self._direct is None:
                self._cache[name] = self._env.agent.is_grasping(self._actors[row]) & near
            else:
                self._cache[name] = np.bool_(near and self._direct.held(row, self._actors[row]))
        return self._cache[name]

    # ---- Contacts.

    def supported(self, key: int, support: int) -> Array:
        """Return whether a support carries at least a quarter of an object's weight (b,).

        PhysX reports no contacts of sleeping bodies: the result from before they fell asleep is kept. An object that
        sleeps since the reset is on its captured support.
        """
        name = ("supported", key, support)
        if name not in self._cache:
            linear, angular = self.speeds(key)
            asleep = (linear == 0) & (angular == 0)
            known = self._supported.get((key, support))
            if known is None:
                known = asleep & self._sleeps_on(key, support)
            if not bool(asleep.all()):
                enough = self._force_on(key, support) >= 0.25 * component(self._weight_n[key], 0)
                known = asleep & known | ~asleep & enough
            self._supported[key, support] = known
            self._cache[name] = known
        return self._cache[name]

    def _sleeps_on(self, key: int, support: int) -> bool:
        """Return whether an object has been sleeping on its captured support since the reset."""
        facts = self._env.facts
        if self._direct is None or facts.parent[key] != support or facts.relation[key] != "supported_by":
            return False
        return all(body.is_sleeping for body in self._actors[self._row[key]]._bodies)

    def rests_on(self, key: int, support: int) -> Array:
        """Return whether an object is at rest and carried by a support (b,).

        Contact queries are slow, so moving objects are excluded first: no object falls asleep before it was at rest.
        """
        rest = self.at_rest(key)
        if self._direct is not None and not rest:
            return rest
        return rest & self.supported(key, support)

    def _force_on(self, key: int, support: int) -> Array:
        """Return the upward force (b,) (N) of a support on an object."""
        others = self._env.builder.carrying_actors(support)
        if self._direct is not None:
            return self._direct.force(self._row[key], others)[2]
        scene, actor = self._env.scene, self._actors[self._row[key]]
        total = torch.zeros((self._env.num_envs, 3), device=self._env.device)
        for other in others:
            total = total + scene.get_pairwise_contact_forces(actor, other)
        return total[:, 2]

    def _turned(self, key: int, axis: int) -> Array:
        """Return the world x or z axis (`axis` 0 or 2) at capture, rotated with the object since (b, 3)."""
        if (key, axis) not in self._axes:
            placed = self._env.builder.objects[key]
            item = next(o for o in self._env.bundle.objects if o.id == key)
            start = placed.actor_from_object[:3, :3] @ item.world_from_object[:3, :3].T
            self._axes[key, axis] = start[:, axis].astype(np.float32)
        direction = self._axes[key, axis]
        if self._direct is not None:
            return self._direct.turned(self._row[key], direction)
        return rotate(self.pose(key)[:, 3:], self.array(direction)[None])
