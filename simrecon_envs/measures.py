"""What tasks read of the simulator, each quantity once a control step. Batched torch; b environments, n movable things.

On the CPU one read a body goes straight to SAPIEN: ManiSkill's structs cost more than the physics does.
"""

from typing import Any

import numpy as np
import torch

from registry.geometry import invert_rigid, transform_points

_GRASP_REACH_M = 0.12  # nothing farther from the hand than this and its own half diagonal is held
_GRAVITY_M_S2 = 9.81


class Measures:
    """Poses, velocities and contacts of the movable things and of the robot."""

    def __init__(self, env: Any) -> None:
        """Find the bodies; `env` is a `SceneEnv` that is built."""
        self._env = env
        self._actors = [placed.actor for placed in env.builder.movable_actors]
        self._row: dict[int, int] = {}
        centers = np.zeros((len(self._actors), 3))
        self._half_diagonal: dict[int, float] = {}
        self._nominal_n: dict[int, float] = {}
        self._weight_n: dict[int, torch.Tensor] = {}
        for number, placed in enumerate(env.builder.movable_actors):
            self._row[placed.id] = number
            target = env.facts.targets[placed.id]
            item = next(o for o in env.bundle.objects if o.id == placed.id)
            actor_from_world = placed.actor_from_object @ invert_rigid(item.world_from_object)
            centers[number] = transform_points(actor_from_world, target.center[None])[0]
            cloud = np.concatenate([s.vertices for s in env.facts.solids if s.owner == placed.id])
            self._half_diagonal[placed.id] = float(np.linalg.norm(cloud - target.center, axis=1).max())
            self._nominal_n[placed.id] = item.mass_kg * _GRAVITY_M_S2
            self._weight_n[placed.id] = torch.full(
                (env.num_envs,), self._nominal_n[placed.id], device=env.device
            )
        self._centers = torch.as_tensor(centers, dtype=torch.float32, device=env.device)[None]
        self._cpu = not env.gpu_sim_enabled
        self._supported: dict[tuple[int, int], torch.Tensor] = {}
        self._cache: dict[Any, torch.Tensor] = {}
        if self._cpu:
            self._entities = [actor._objs[0] for actor in self._actors]
            self._bodies = [actor._bodies[0] for actor in self._actors]

    def refresh(self) -> None:
        """Forget what was read: the simulator has moved on."""
        self._cache = {}

    def forget(self, env_idx: torch.Tensor) -> None:
        """Forget what carried what in the environments that start anew."""
        self.refresh()
        for known in self._supported.values():
            known[env_idx] = False

    def scale_weight(self, key: int, env_idx: torch.Tensor, factor: torch.Tensor) -> None:
        """Say that a thing is heavier by a factor (len(env_idx),) than the bundle says."""
        self._weight_n[key][env_idx] = self._nominal_n[key] * factor

    # ---- Things.

    @property
    def poses(self) -> torch.Tensor:
        """Return the actors' poses (b, n, 7): position, quaternion wxyz; world."""
        if "poses" not in self._cache:
            if self._cpu:
                rows = np.empty((1, len(self._entities), 7), np.float32)
                for row, entity in zip(rows[0], self._entities):
                    pose = entity.pose
                    row[:3], row[3:] = pose.p, pose.q
                self._cache["poses"] = torch.from_numpy(rows)
            else:
                self._cache["poses"] = torch.stack([a.pose.raw_pose for a in self._actors], dim=1)
        return self._cache["poses"]

    @property
    def positions(self) -> torch.Tensor:
        """Return where the things' box centres are (b, n, 3)."""
        if "positions" not in self._cache:
            poses = self.poses
            self._cache["positions"] = poses[..., :3] + rotate(poses[..., 3:], self._centers)
        return self._cache["positions"]

    def position(self, key: int) -> torch.Tensor:
        """Return where a thing's box centre is (b, 3)."""
        if ("position", key) not in self._cache:
            pose, row = self.poses[:, self._row[key]], self._row[key]
            self._cache["position", key] = pose[:, :3] + rotate(pose[:, 3:], self._centers[:, row])
        return self._cache["position", key]

    def pose(self, key: int) -> torch.Tensor:
        """Return the pose (b, 7) of a thing's box centre, with the orientation of its actor."""
        return torch.cat([self.position(key), self.poses[:, self._row[key], 3:]], dim=1)

    def up(self, key: int) -> torch.Tensor:
        """Return by which cosine (b,) a thing's upright axis still points up, as in the bundle."""
        quat = self.poses[:, self._row[key], 3:]
        return rotate(quat, self._start_axis(key, 2))[:, 2]

    def yaw(self, key: int) -> torch.Tensor:
        """Return by which angle (b,) a thing is turned about +z from how it was captured."""
        quat = self.poses[:, self._row[key], 3:]
        side = rotate(quat, self._start_axis(key, 0))
        return torch.atan2(side[:, 1], side[:, 0])

    def speeds(self, key: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the linear (m/s) and angular (rad/s) speed (b,) of a thing."""
        name = ("speed", key)
        if name not in self._cache:
            if self._cpu:
                body = self._bodies[self._row[key]]
                pair = [
                    float(np.linalg.norm(body.linear_velocity)),
                    float(np.linalg.norm(body.angular_velocity)),
                ]
                self._cache[name] = torch.tensor([pair])
            else:
                actor = self._actors[self._row[key]]
                pair = [torch.linalg.norm(v, dim=1) for v in (actor.linear_velocity, actor.angular_velocity)]
                self._cache[name] = torch.stack(pair, dim=1)
        both = self._cache[name]
        return both[:, 0], both[:, 1]

    def at_rest(self, key: int, linear_m_s: float = 0.05, angular_rad_s: float = 0.6) -> torch.Tensor:
        """Return whether a thing hardly moves (b,)."""
        linear, angular = self.speeds(key)
        return (linear <= linear_m_s) & (angular <= angular_rad_s)

    # ---- The robot.

    @property
    def tcp(self) -> torch.Tensor:
        """Return the pose (b, 7) of the point between the fingers."""
        if "tcp" not in self._cache:
            link = self._env.agent.tcp
            if self._cpu:
                pose = link._objs[0].entity_pose
                self._cache["tcp"] = torch.from_numpy(
                    np.concatenate([pose.p, pose.q])[None].astype(np.float32)
                )
            else:
                self._cache["tcp"] = link.pose.raw_pose
        return self._cache["tcp"]

    @property
    def joint_speed(self) -> torch.Tensor:
        """Return the speed (b,) of the robot's fastest joint, fingers left out."""
        if "joint_speed" not in self._cache:
            qvel = self._env.agent.robot.get_qvel()
            keep = qvel.shape[1] - 2 if qvel.shape[1] > 2 else qvel.shape[1]
            self._cache["joint_speed"] = torch.abs(qvel[:, :keep]).amax(dim=1)
        return self._cache["joint_speed"]

    def held(self, key: int) -> torch.Tensor:
        """Return whether the robot holds a thing between its fingers (b,)."""
        name = ("held", key)
        if name not in self._cache:
            agent = self._env.agent
            distance = torch.linalg.norm(self.position(key) - self.tcp[:, :3], dim=1)
            near = distance <= self._half_diagonal[key] + _GRASP_REACH_M
            if self._cpu and not bool(near[0]):
                self._cache[name] = near
            else:
                self._cache[name] = agent.is_grasping(self._actors[self._row[key]]) & near
        return self._cache[name]

    # ---- Contacts.

    def supported(self, key: int, support: int) -> torch.Tensor:
        """Return whether a support carries a good part of a thing's weight (b,).

        PhysX reports no contacts of bodies that sleep; what was so when they fell asleep still is.
        """
        name = ("supported", key, support)
        if name not in self._cache:
            linear, angular = self.speeds(key)
            asleep = (linear == 0) & (angular == 0)
            known = self._supported.setdefault(
                (key, support), torch.zeros(len(asleep), dtype=torch.bool, device=asleep.device)
            )
            if not bool(asleep.all()):
                force = self._force_on(key, support)
                known = torch.where(asleep, known, force[:, 2] >= 0.25 * self._weight_n[key])
                self._supported[(key, support)] = known
            self._cache[name] = known
        return self._cache[name]

    def _force_on(self, key: int, support: int) -> torch.Tensor:
        scene, actor = self._env.scene, self._actors[self._row[key]]
        total = torch.zeros((self._env.num_envs, 3), device=self._env.device)
        for other in self._env.builder.carrying_actors(support):
            total = total + scene.get_pairwise_contact_forces(actor, other)
        return total

    def _start_axis(self, key: int, axis: int) -> torch.Tensor:
        """Return which direction (1, 3) of the actor was the world's x or z when it was captured."""
        placed = self._env.builder.objects[key]
        item = next(o for o in self._env.bundle.objects if o.id == key)
        direction = (placed.actor_from_object[:3, :3] @ item.world_from_object[:3, :3].T)[:, axis]
        return torch.as_tensor(direction, dtype=torch.float32, device=self._env.device)[None]


def rotate(quat: torch.Tensor, vector: torch.Tensor) -> torch.Tensor:
    """Rotate vectors (..., 3) by unit quaternions wxyz (..., 4)."""
    vector = vector.expand(*quat.shape[:-1], 3)
    axis = quat[..., 1:]
    twice = 2.0 * torch.linalg.cross(axis, vector)
    return vector + quat[..., :1] * twice + torch.linalg.cross(axis, twice)
