"""Fast reads and controllers for one environment on the CPU, on SAPIEN's own objects.

ManiSkill's structs return batched tensors. For one environment, creating these tensors costs more than the physics.
This module gives the same numbers.
"""

import math
from typing import Any

import numpy as np
import sapien
import torch
from mani_skill.agents.base_agent import BaseAgent
from mani_skill.agents.controllers.base_controller import BaseController, CombinedController
from mani_skill.agents.controllers.pd_ee_pose import PDEEPosController, PDEEPoseController
from mani_skill.agents.controllers.pd_joint_pos import PDJointPosController, PDJointPosMimicController
from mani_skill.agents.robots import Fetch, Panda

_MARGIN_M = 0.02  # of bounding boxes; above the contact offset of PhysX
_STILL = np.float32(0)
_GRASP_N, _GRASP_DEG = 0.5, 85  # minimum force and maximum angle, as in `is_grasping`
# Phases of the inverse kinematics: step size (share of the error), maximum steps, tolerance. ManiSkill uses steps of a
# tenth until 1e-4. Here three half steps choose the elbow configuration, full steps converge quadratically, and
# ManiSkill's steps are the fallback.
_PHASES = np.array([[0.5, 3, 1e-5], [1.0, 12, 1e-5], [0.1, 100, 1e-4]])
# Above this error (m, rad) after the full steps, the goal is out of reach: ManiSkill's steps come no closer either.
_OUT_OF_REACH = 2e-3
_HALF_TURN_RAD = 3.0  # rotations near half a turn have no unique axis


class DirectReads:
    """Read poses, velocities and contacts of movable objects and robot; contacts are cached per control step."""

    def __init__(self, env: Any, actors: list[Any], centers: np.ndarray) -> None:
        """Collect the bodies.

        Args:
            env: A built `SceneEnv` with one environment on the CPU.
            actors: Actors of the n movable objects.
            centers: Their box centres (n, 3) in actor space (m).
        """
        self._env = env
        self._entities = [actor._objs[0] for actor in actors]
        self.bodies = [actor._bodies[0] for actor in actors]
        self._centers = [sapien.Pose(center) for center in centers]
        self._tip: Any = env.agent.tcp._objs[0].entity if hasattr(env.agent, "tcp") else None
        self._links = set() if env.agent is None else {id(link._objs[0]) for link in env.agent.robot.links}
        self.poses = np.zeros((1, len(actors), 7), np.float32)
        """Actor poses (1, n, 7) in world space at the last `refresh`: position (m), quaternion wxyz."""
        self.tcp = np.zeros((1, 7), np.float32)
        """Pose (1, 7) of the tool centre point (between the fingertips) at the last `refresh`."""
        self._spot: Any = None  # cache of `tip`
        self._size, self._places = 0, np.zeros((0, 7), np.int64)
        self._touching: dict[int, list[tuple[Any, Any, int]]] = {}
        self._all_contacts: Any = None
        self._boxes: dict[int, list[list[float]]] = {}
        self._fingers: list[Any] = []
        self._opening: tuple[int, ...] = ()
        for known, opening in ((Panda, (1, -1)), (Fetch, (-1, 1))):
            if env.agent is not None and type(env.agent).is_grasping is known.is_grasping:
                self._fingers = [env.agent.finger1_link._objs[0], env.agent.finger2_link._objs[0]]
                self._opening = opening

    def find(self) -> None:
        """Find the bodies among the scene's entities; necessary after a reset, which changes them."""
        entities = list(self._env.scene.sub_scenes[0].entities)
        number = {id(entity): k for k, entity in enumerate(entities)}
        wanted = [*self._entities, *([] if self._tip is None else [self._tip])]
        # SAPIEN packs the quaternion and position of every entity, in order.
        starts = np.array([7 * number[id(entity)] for entity in wanted], np.int64).reshape(-1, 1)
        self._places = starts + np.array([4, 5, 6, 0, 1, 2, 3])
        self._size = 28 * len(entities)

    def refresh(self) -> list[int]:
        """Read the poses and clear cached contacts after a simulation step; return the rows of objects that moved."""
        self._touching, self._all_contacts, self._boxes, self._spot = {}, None, {}, None
        packed = self._env.scene.sub_scenes[0].pack_poses()
        if len(packed) != self._size:
            self.find()
        rows = np.frombuffer(packed, np.float32).take(self._places)
        self.tcp = rows[-1:]  # not used for a robot without a hand
        count = len(self._entities)
        poses, before = rows[:count], self.poses[0]
        if poses.tobytes() == before.tobytes():
            return []
        self.poses = poses[None]
        return np.flatnonzero((poses != before).any(1)).tolist()

    def tip(self) -> list[float]:
        """Return the position (3,) of the tool centre point."""
        if self._spot is None:
            self._spot = self.tcp[0, :3].tolist()
        return self._spot

    def pose(self, row: int) -> np.ndarray:
        """Return the pose (1, 7) of an object's box centre, with the orientation of its actor."""
        return _row(self._entities[row].pose * self._centers[row])

    def turned(self, row: int, direction: np.ndarray) -> np.ndarray:
        """Rotate a direction (3,) from actor space to world space (1, 3)."""
        return (self._entities[row].pose.to_transformation_matrix()[:3, :3] @ direction)[None]

    def speeds(self, row: int) -> tuple[np.float32, np.float32]:
        """Return the linear (m/s) and angular (rad/s) speed of an object."""
        body = self.bodies[row]
        if body.is_sleeping:  # PhysX sets its velocity to 0
            return _STILL, _STILL
        linear, angular = body.linear_velocity.tolist(), body.angular_velocity.tolist()
        return np.float32(math.hypot(*linear)), np.float32(math.hypot(*angular))

    def link_pose(self, link: Any) -> np.ndarray:
        """Return the pose (1, 7) of a link of the robot."""
        return _row(link._objs[0].entity_pose)

    def qvel(self) -> np.ndarray:
        """Return the joint velocities (1, d) of the robot (rad/s, m/s)."""
        return self._env.agent.robot._objs[0].qvel[None]

    def joint_speed(self) -> np.float32:
        """Return the speed of the robot's fastest joint, without the fingers."""
        speeds = self._env.agent.robot._objs[0].qvel.tolist()
        return np.float32(max(map(abs, speeds[:-2] if len(speeds) > 2 else speeds)))

    def held(self, row: int, actor: Any) -> bool:
        """Return `is_grasping` of the robot for an object; cheap tests exclude impossible cases first."""
        if self._fingers and not self._may_touch(row):
            return False
        touching = {id(other) for _, other, _ in self._contacts(row)}
        if not self._fingers:
            # Fewer than two links in contact cannot grasp it.
            return len(touching & self._links) > 1 and bool(self._env.agent.is_grasping(actor))
        return all(id(finger) in touching for finger in self._fingers) and self._pressed(row)

    def _may_touch(self, row: int) -> bool:
        """Return whether the object's bounding box meets those of both fingers; contact queries are slow."""
        return all(self._meet(self.bodies[row], finger) for finger in self._fingers)

    def _meet(self, one: Any, other: Any) -> bool:
        """Return whether the bounding boxes of two bodies overlap, with a margin."""
        (low, high), (least, most) = self._box(one), self._box(other)
        return all(least[k] <= high[k] + _MARGIN_M and most[k] >= low[k] - _MARGIN_M for k in (0, 1, 2))

    def _box(self, body: Any) -> list[list[float]]:
        """Return the minimum and maximum corner of a body's bounding box."""
        if id(body) not in self._boxes:
            self._boxes[id(body)] = body.get_global_aabb_fast().tolist()
        return self._boxes[id(body)]

    def _pressed(self, row: int) -> bool:
        """Return `is_grasping` of Panda and Fetch: both fingers press on the object along the closing direction."""
        for finger, sign in zip(self._fingers, self._opening, strict=True):
            force = -self._force(row, {id(finger)})
            size = float(np.linalg.norm(force))
            if size < _GRASP_N:
                return False
            opening = sign * finger.entity_pose.to_transformation_matrix()[:3, 1]
            cosine = float(np.clip(opening @ force / (size * np.linalg.norm(opening)), -1, 1))
            if math.degrees(math.acos(cosine)) > _GRASP_DEG:
                return False
        return True

    def force(self, row: int, others: list) -> np.ndarray:
        """Return the contact force (3,) (N) of other actors on an object."""
        bodies = [other._bodies[0] for other in others]
        near = {id(body) for body in bodies if self._meet(self.bodies[row], body)}
        return self._force(row, near) if near else np.zeros(3, np.float32)

    def _force(self, row: int, wanted: set[int]) -> np.ndarray:
        """Return the contact force (3,) (N) on an object by the bodies with these Python ids."""
        total = np.zeros(3)
        for contact, other, sign in self._contacts(row):
            if id(other) in wanted:
                total += sign * np.sum([point.impulse for point in contact.points], axis=0)
        return (total / self._env.scene.px.timestep).astype(np.float32)

    def _contacts(self, row: int) -> list[tuple[Any, Any, int]]:
        """Return an object's contacts: contact, other body, and the sign of the impulse on the object.

        Bodies can be compared by identity: SAPIEN keeps one Python object per body while it is referenced, and
        ManiSkill's structs reference all.
        """
        if row not in self._touching:
            if self._all_contacts is None:
                self._all_contacts = self._env.scene.px.get_contacts()
            self._touching[row], mine = [], self.bodies[row]
            # There may be a hundred contacts: filter first.
            for contact in [each for each in self._all_contacts if mine in each.bodies]:
                first, second = contact.bodies
                self._touching[row].append((contact, second, 1) if first is mine else (contact, first, -1))
        return self._touching[row]


class DirectDrive:
    """Faster versions of ManiSkill's joint and hand controllers; other controllers are called unchanged."""

    def __init__(self, agent: BaseAgent) -> None:
        """Read the current controllers of an agent."""
        self.controller = agent.controller
        self._robot = agent.robot._objs[0]
        self.foreign: list[tuple[slice, BaseController]] = []
        """Controllers called unchanged, with their slice of the action."""
        children, joints, tips = [], [], []
        if type(self.controller) is CombinedController:
            for name, child in self.controller.controllers.items():
                share = slice(*self.controller.action_mapping[name])
                children.append(child)
                if _Joints.fits(child):
                    joints.append((share, child))
                elif _Tip.fits(child):
                    tips.append((share, child))
                else:
                    self.foreign.append((share, child))
        self._joints = _Joints(joints)
        self._tips = [_Tip(*tip) for tip in tips]
        driven = [controller for _, controller in (*joints, *tips)]
        self._targets = _Targets(driven) if driven else None
        idle = {BaseController.before_simulation_step, PDJointPosController.before_simulation_step}
        self.idle = (
            bool(children)
            and type(agent).before_simulation_step is BaseAgent.before_simulation_step
            and all(
                type(child).before_simulation_step in idle and not getattr(child.config, "interpolate", False)
                for child in children
            )
        )
        """Whether no controller acts between the time steps of a control step."""

    def set_action(self, action: torch.Tensor, numbers: np.ndarray, listed: list[float]) -> None:
        """Set the joint targets for an action, as `controller.set_action` does.

        Args:
            action: (1, k).
            numbers: The same, (k,).
            listed: The same, as floats.
        """
        if self._targets is None:
            self.controller.set_action(action)
            return
        qpos = self._robot.qpos
        # Python floats: right after the physics, with cold caches, a NumPy operation is slower.
        angles = qpos.tolist()
        wanted = self._joints.targets(angles, listed)
        for tip in self._tips:
            wanted += tip.targets(qpos, angles, numbers)
        self._targets.set(qpos, wanted)
        for share, child in self.foreign:
            child.set_action(action[:, share])


class _Joints:
    """All joint position controllers (mimic joints included) without interpolation and virtual targets, merged."""

    @staticmethod
    def fits(controller: BaseController) -> bool:
        """Return whether `targets` computes the same as this controller."""
        config: Any = controller.config
        plain = type(controller) in (PDJointPosController, PDJointPosMimicController)
        return plain and not (config.interpolate or config.use_target)

    def __init__(self, parts: list[tuple[slice, PDJointPosController]]) -> None:
        self._rows = [row for part in parts for row in _rows(*part)]

    def targets(self, angles: list[float], action: list[float]) -> list[float]:
        """Return the joint targets, in the order of the controllers.

        Args:
            angles: Positions (d,) of all joints.
            action: The whole action (k,).
        """
        wanted = []
        for source, number, bound, delta, middle, half in self._rows:
            told = action[number]
            if not -bound <= told <= bound:
                told = bound if told > 0 else -bound
            wanted.append(delta * angles[source] + middle + half * told)
        return wanted


def _rows(
    share: slice, controller: PDJointPosController
) -> list[tuple[int, int, float, float, float, float]]:
    """Return per joint (source, number, bound, delta, middle, half).

    The target is delta * angles[source] + middle + half * action[number], with the action clipped to the bound.
    """
    indices = controller.active_joint_indices.numpy()
    count = len(indices)
    source, factor, offset = np.arange(count), np.ones(count), np.zeros(count)
    control = source
    if type(controller) is PDJointPosMimicController:
        groups: Any = (
            controller.control_joint_indices, controller.mimic_joint_indices, controller.mimic_control_joint_indices
        )  # fmt: skip
        control, mimic, leader = (group.numpy().reshape(-1) for group in groups)
        source[mimic], factor[mimic], offset[mimic] = leader, controller._multiplier, controller._offset
    number = np.zeros(count, int)
    number[control] = share.start + np.arange(len(control))
    middle, half, bound = np.zeros(len(control)), np.ones(len(control)), np.inf
    if controller._normalize_action:
        low, high = _bounds(controller)
        middle, half, bound = 0.5 * (high + low), 0.5 * (high - low), 1.0
    scale = np.zeros((2, count))
    scale[:, control] = middle, half
    middle, half = scale[:, source]
    delta = factor * float(controller.config.use_delta)
    middle, half = factor * middle + offset, factor * half
    columns = indices[source], number[source], np.full(count, bound), delta, middle, half
    return list(zip(*(column.tolist() for column in columns), strict=True))


class _Tip:
    """A delta `PDEEPoseController` or `PDEEPosController` in the root-aligned frame that ManiSkill's robots use."""

    @staticmethod
    def fits(controller: BaseController) -> bool:
        """Return whether `targets` computes the same as this controller."""
        frames = {
            PDEEPoseController: "root_translation:root_aligned_body_rotation",
            PDEEPosController: "root_translation",
        }
        config: Any = controller.config
        if type(controller) not in frames or config.interpolate or config.use_target:
            return False
        plain = config.use_delta and controller._normalize_action
        less = type(controller) is PDEEPosController or abs(config.rot_lower) < _HALF_TURN_RAD
        return plain and less and config.frame == frames[type(controller)]

    def __init__(self, share: slice, controller: PDEEPosController) -> None:
        from simrecon_envs import inverse_kinematics

        self._follow = inverse_kinematics.follow
        self._share = share
        self._indices = controller.active_joint_indices.tolist()
        low, high = (bound[:3] for bound in _bounds(controller))
        turn = controller.config.rot_lower if type(controller) is PDEEPoseController else 0.0
        scale = np.array([0.5 * (high + low), 0.5 * (high - low), np.full(3, turn)], np.float64)
        kinematics = controller.kinematics
        model, hand = kinematics.pmodel, kinematics.end_link_idx
        straight = np.zeros(len(kinematics.qmask))
        model.compute_forward_kinematics(straight)
        home = model.get_link_pose(hand).to_transformation_matrix()[:3].astype(np.float64)
        model.compute_full_jacobian(straight)
        screws = model.get_link_jacobian(hand, local=False).T
        free = kinematics.qmask.numpy()
        chain = np.flatnonzero((screws != 0).any(axis=1) | free)  # without fingers and head
        screws, free = np.ascontiguousarray(screws[chain]), free[chain]
        known = kinematics.pmodel_active_joint_indices.numpy()[chain].astype(np.int64)
        motions = inverse_kinematics.motions(screws)
        self._arm = (screws, motions, free, home, _PHASES, _OUT_OF_REACH, scale, known)
        self._angles = np.zeros(len(chain))
        controlled = kinematics.pmodel_controlled_joint_indices.tolist()
        self._found = [chain.tolist().index(number) for number in controlled]
        # Compile or load the kernels now, not in the first step.
        qpos, action = (np.zeros(size, np.float32) for size in (known.max() + 1, share.stop - share.start))
        self._follow(*self._arm, qpos, action, self._angles)

    def targets(self, qpos: np.ndarray, angles: list[float], action: np.ndarray) -> list[float]:
        """Return the joint targets that move the hand by the action; the current positions if it is out of reach.

        Args:
            qpos: Positions (d,) of all joints.
            angles: The same, as floats.
            action: The whole action (k,).
        """
        if not self._follow(*self._arm, qpos, action[self._share], self._angles):
            return [angles[k] for k in self._indices]
        found = self._angles.tolist()
        return [found[k] for k in self._found]


class _Targets:
    """Write joint targets to SAPIEN, and to the controller attributes that `get_state` and trajectory tools read."""

    def __init__(self, controllers: list[PDJointPosController]) -> None:
        joints = [joint._objs[0] for controller in controllers for joint in controller.joints]
        self._set = [joint.set_drive_target for joint in joints]
        self._indices = np.concatenate([c.active_joint_indices.numpy() for c in controllers]).astype(np.intp)
        # Reused in every step: creating tensors costs more than setting the targets.
        start, target = (torch.zeros((1, len(joints))) for _ in range(2))
        self._start, self._target = start.numpy()[0], target.numpy()[0]
        counts = [len(controller.joints) for controller in controllers]
        self._parts = list(zip(controllers, start.split(counts, 1), target.split(counts, 1), strict=True))

    def set(self, qpos: np.ndarray, target: list[float]) -> None:
        """Set the joint targets (k,) of a robot at `qpos` (d,)."""
        for controller, before, after in self._parts:
            controller._step = 0
            controller._start_qpos, controller._target_qpos = before, after
        qpos.take(self._indices, out=self._start, mode="clip")  # "raise" would buffer the output
        self._target[:] = target
        for give, value in zip(self._set, target, strict=True):
            give(value)


def _bounds(controller: Any) -> tuple[np.ndarray, np.ndarray]:
    return controller.action_space_low.numpy(), controller.action_space_high.numpy()


def _row(pose: sapien.Pose) -> np.ndarray:
    return np.array([pose.__getstate__()], np.float32)
