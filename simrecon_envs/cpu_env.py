"""One environment on the CPU, straight from and to SAPIEN.

ManiSkill's structs hold every quantity as a batched tensor: for one environment, a tensor of three numbers costs more
than reading them, and all of them together more than the physics does. What is here gives the same numbers.
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

_MARGIN_M = 0.02  # more than PhysX keeps between bodies in contact
_STILL = np.float32(0)
_GRASP_N, _GRASP_DEG = 0.5, 85  # as in `is_grasping`
# Inverse kinematics: ManiSkill's goes a tenth of the way to the goal a step, until 1e-4 are left. Here three steps go
# half of it, which decides where the elbow is, and the others all of it, where each leaves about the square of what the
# one before left. At last as ManiSkill's. A row: share of the way, at most so many steps, until so much is left.
_PHASES = np.array([[0.5, 3, 1e-5], [1.0, 12, 1e-5], [0.1, 100, 1e-4]])
# What is left after them (m, rad) where the hand cannot get: ManiSkill's steps end no nearer.
_OUT_OF_REACH = 2e-3
_HALF_TURN_RAD = 3.0  # from about which on the way to a goal is not one way any more


class DirectReads:
    """Poses, velocities and contacts of things and robot; each thing's contacts once a control step."""

    def __init__(self, env: Any, actors: list, centers: np.ndarray) -> None:
        """Find the bodies.

        Args:
            env: A `SceneEnv` that is built, with one environment on the CPU.
            actors: The movable things' actors, n of them.
            centers: Their box centres (n, 3) in the actors' space (m).
        """
        self._env = env
        self._entities = [actor._objs[0] for actor in actors]
        self.bodies = [actor._bodies[0] for actor in actors]
        self._centers = [sapien.Pose(center) for center in centers]
        self._links = set() if env.agent is None else {id(link._objs[0]) for link in env.agent.robot.links}
        self.poses = np.zeros((1, len(actors), 7), np.float32)
        """The actors' poses: position (m), quaternion wxyz; world; as of the last `refresh`."""
        self._tip = env.agent.tcp._objs[0].entity if hasattr(env.agent, "tcp") else None
        self.tcp = np.zeros((1, 7), np.float32)
        """The pose of the point between the fingers, as of the last `refresh`."""
        self._spot: list[float] | None = None
        self._size, self._places = 0, np.zeros((0, 7), np.int64)
        self._touching: dict[int, list] = {}
        self._all_contacts: list | None = None
        self._boxes: dict[int, list] = {}
        self._fingers, self._opening = None, ()
        for known, opening in ((Panda, (1, -1)), (Fetch, (-1, 1))):
            if env.agent is not None and type(env.agent).is_grasping is known.is_grasping:
                self._fingers = [env.agent.finger1_link._objs[0], env.agent.finger2_link._objs[0]]
                self._opening = opening

    def find(self) -> None:
        """Look where the bodies are among the scene's entities: an environment that starts anew has others."""
        entities = list(self._env.scene.sub_scenes[0].entities)
        number = {id(entity): k for k, entity in enumerate(entities)}
        wanted = [*self._entities, *([] if self._tip is None else [self._tip])]
        # SAPIEN packs quaternion and position of every entity in their order.
        starts = np.array([7 * number[id(entity)] for entity in wanted], np.int64).reshape(-1, 1)
        self._places = starts + np.array([4, 5, 6, 0, 1, 2, 3])
        self._size = 28 * len(entities)

    def refresh(self) -> list[int]:
        """Read the poses and forget the contacts: the simulator has moved on. Return the rows of what moved."""
        self._touching, self._all_contacts, self._boxes, self._spot = {}, None, {}, None
        packed = self._env.scene.sub_scenes[0].pack_poses()
        if len(packed) != self._size:
            self.find()
        rows = np.frombuffer(packed, np.float32).take(self._places)
        self.tcp = rows[-1:]  # of a robot without a hand nobody asks it
        count = len(self._entities)
        poses, before = rows[:count], self.poses[0]
        if poses.tobytes() == before.tobytes():
            return []
        self.poses = poses[None]
        return np.flatnonzero((poses != before).any(1)).tolist()

    def tip(self) -> list[float]:
        """Return where (3,) the point between the fingers is."""
        if self._spot is None:
            self._spot = self.tcp[0, :3].tolist()
        return self._spot

    def pose(self, row: int) -> np.ndarray:
        """Return the pose (1, 7) of a thing's box centre, with the orientation of its actor."""
        return _row(self._entities[row].pose * self._centers[row])

    def turned(self, row: int, direction: np.ndarray) -> np.ndarray:
        """Return where (1, 3) a direction (3,) of a thing's actor points in the world."""
        return (self._entities[row].pose.to_transformation_matrix()[:3, :3] @ direction)[None]

    def speeds(self, row: int) -> tuple[np.float32, np.float32]:
        """Return the linear (m/s) and angular (rad/s) speed of a thing."""
        body = self.bodies[row]
        if body.is_sleeping:  # which PhysX stops
            return _STILL, _STILL
        linear, angular = body.linear_velocity.tolist(), body.angular_velocity.tolist()
        return np.float32(math.hypot(*linear)), np.float32(math.hypot(*angular))

    def link_pose(self, link: Any) -> np.ndarray:
        """Return the pose (1, 7) of one of the robot's links."""
        return _row(link._objs[0].entity_pose)

    def qvel(self) -> np.ndarray:
        """Return the speeds (1, d) of the robot's joints (rad/s, m/s)."""
        return self._env.agent.robot._objs[0].qvel[None]

    def joint_speed(self) -> np.float32:
        """Return the speed of the robot's fastest joint, fingers left out."""
        speeds = self._env.agent.robot._objs[0].qvel.tolist()
        return np.float32(max(map(abs, speeds[:-2] if len(speeds) > 2 else speeds)))

    def held(self, row: int, actor: Any) -> bool:
        """Return whether the robot says that it grasps a thing, without asking it where that cannot be."""
        if self._fingers is not None and not self._may_touch(row):
            return False
        touching = {id(other) for _, other, _ in self._contacts(row)}
        if self._fingers is None:
            # Less than two links cannot hold it.
            return len(touching & self._links) > 1 and bool(self._env.agent.is_grasping(actor))
        return all(id(finger) in touching for finger in self._fingers) and self._pressed(row)

    def _may_touch(self, row: int) -> bool:
        """Return whether the box around the thing meets those around both fingers: asking for contacts is slow."""
        return all(self._meet(self.bodies[row], finger) for finger in self._fingers)

    def _meet(self, one: Any, other: Any) -> bool:
        """Return whether the boxes around two bodies meet."""
        (low, high), (least, most) = self._box(one), self._box(other)
        return all(least[k] <= high[k] + _MARGIN_M and most[k] >= low[k] - _MARGIN_M for k in (0, 1, 2))

    def _box(self, body: Any) -> list[list[float]]:
        """Return the least and the largest corner of the box around a body."""
        if id(body) not in self._boxes:
            self._boxes[id(body)] = body.get_global_aabb_fast().tolist()
        return self._boxes[id(body)]

    def _pressed(self, row: int) -> bool:
        """Return what `is_grasping` of the Panda and Fetch does: both fingers press on it, from where they close."""
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
        """Return the force (3,) (N) of other actors on a thing."""
        bodies = [other._bodies[0] for other in others]
        near = {id(body) for body in bodies if self._meet(self.bodies[row], body)}
        return self._force(row, near) if near else np.zeros(3, np.float32)

    def _force(self, row: int, wanted: set[int]) -> np.ndarray:
        """Return the force (3,) (N) on a thing of the bodies with these ids."""
        total = np.zeros(3)
        for contact, other, sign in self._contacts(row):
            if id(other) in wanted:
                total += sign * np.sum([point.impulse for point in contact.points], axis=0)
        return (total / self._env.scene.px.timestep).astype(np.float32)

    def _contacts(self, row: int) -> list[tuple[Any, Any, int]]:
        """Return a thing's contacts, what it touches there, and 1 where the impulse acts on it, else -1.

        SAPIEN gives one and the same object for a body as long as somebody holds it, as ManiSkill's structs do.
        """
        if row not in self._touching:
            if self._all_contacts is None:
                self._all_contacts = self._env.scene.px.get_contacts()
            self._touching[row], mine = [], self.bodies[row]
            # There may be a hundred, of all pairs of shapes: most are only asked whether they are this thing's.
            for contact in [each for each in self._all_contacts if mine in each.bodies]:
                first, second = contact.bodies
                self._touching[row].append((contact, second, 1) if first is mine else (contact, first, -1))
        return self._touching[row]


class DirectDrive:
    """ManiSkill's controllers of joints and hand on the CPU; other controllers do as they always do."""

    def __init__(self, agent: BaseAgent) -> None:
        """Look at the controllers that the agent has now."""
        self.controller = agent.controller
        self._robot = agent.robot._objs[0]
        self.foreign: list[tuple[slice, BaseController]] = []
        """Those that ManiSkill drives itself, with their share of the action."""
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
        """Whether controllers have nothing to do between a control step's time steps."""

    def set_action(self, action: torch.Tensor, numbers: np.ndarray, listed: list[float]) -> None:
        """Give the controllers an action (1, k), whose numbers are (k,) twice, as `controller.set_action` does."""
        if self._targets is None:
            self.controller.set_action(action)
            return
        qpos = self._robot.qpos
        # In Python's numbers: right after the physics each operation of NumPy costs several of them.
        angles = qpos.tolist()
        wanted = self._joints.targets(angles, listed)
        for tip in self._tips:
            wanted += tip.targets(qpos, angles, numbers)
        self._targets.set(qpos, wanted)
        for share, child in self.foreign:
            child.set_action(action[:, share])


class _Joints:
    """All `PDJointPosController`, and those with mimicked joints, without interpolation and virtual targets, as one."""

    @staticmethod
    def fits(controller: BaseController) -> bool:
        """Return whether a controller does nothing but what `drive` does."""
        plain = type(controller) in (PDJointPosController, PDJointPosMimicController)
        return plain and not (controller.config.interpolate or controller.config.use_target)

    def __init__(self, parts: list[tuple[slice, PDJointPosController]]) -> None:
        self._rows = [row for part in parts for row in _rows(*part)]

    def targets(self, angles: list[float], action: list[float]) -> list[float]:
        """Return the targets of joints, whose controllers' joints come one after the other.

        Args:
            angles: Where all of the robot's joints are (d,).
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
    """Return of each joint whose angle and which number of the action its target comes from, and how.

    A row is (source, number, bound, delta, middle, half); the target is
    delta * angle + middle + half * action, the action within the bound.
    """
    indices = controller.active_joint_indices.numpy()
    count = len(indices)
    source, factor, offset = np.arange(count), np.ones(count), np.zeros(count)
    control = source
    if type(controller) is PDJointPosMimicController:
        control, mimic, leader = (
            column.numpy().reshape(-1)
            for column in (controller.control_joint_indices, controller.mimic_joint_indices,
                           controller.mimic_control_joint_indices)
        )  # fmt: skip
        source[mimic], factor[mimic], offset[mimic] = leader, controller._multiplier, controller._offset
    number = np.zeros(count, int)
    number[control] = share.start + np.arange(len(control))
    middle, half, bound = np.zeros(len(control)), np.ones(len(control)), np.inf
    if controller._normalize_action:
        low, high = controller.action_space_low.numpy(), controller.action_space_high.numpy()
        middle, half, bound = 0.5 * (high + low), 0.5 * (high - low), 1.0
    scale = np.zeros((2, count))
    scale[:, control] = middle, half
    middle, half = scale[:, source]
    delta = factor * float(controller.config.use_delta)
    columns = (
        indices[source],
        number[source],
        np.full(count, bound),
        delta,
        factor * middle + offset,
        factor * half,
    )
    return list(zip(*(column.tolist() for column in columns), strict=True))


class _Tip:
    """A `PDEEPoseController` or `PDEEPosController` of changes, in the frame that ManiSkill's robots have it in."""

    @staticmethod
    def fits(controller: BaseController) -> bool:
        """Return whether a controller does nothing but what `drive` does."""
        frames = {
            PDEEPoseController: "root_translation:root_aligned_body_rotation",
            PDEEPosController: "root_translation",
        }
        if type(controller) not in frames or controller.config.interpolate or controller.config.use_target:
            return False
        plain = controller.config.use_delta and controller._normalize_action
        less = type(controller) is PDEEPosController or abs(controller.config.rot_lower) < _HALF_TURN_RAD
        return plain and less and controller.config.frame == frames[type(controller)]

    def __init__(self, share: slice, controller: PDEEPosController) -> None:

        from simrecon_envs import inverse_kinematics

        self._follow = inverse_kinematics.follow
        self._share = share
        self._indices = controller.active_joint_indices.tolist()
        low, high = controller.action_space_low.numpy()[:3], controller.action_space_high.numpy()[:3]
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
        chain = np.flatnonzero((screws != 0).any(axis=1) | free)  # not the fingers, nor the head
        screws, free = np.ascontiguousarray(screws[chain]), free[chain]
        known = kinematics.pmodel_active_joint_indices.numpy()[chain].astype(np.int64)
        self._arm = (
            screws,
            inverse_kinematics.motions(screws),
            free,
            home,
            _PHASES,
            _OUT_OF_REACH,
            scale,
            known,
        )
        self._angles = np.zeros(len(chain))
        self._found = [
            chain.tolist().index(number) for number in kinematics.pmodel_controlled_joint_indices.tolist()
        ]
        # Compiled or loaded now, not at the first step.
        width = share.stop - share.start
        self._follow(
            *self._arm, np.zeros(known.max() + 1, np.float32), np.zeros(width, np.float32), self._angles
        )

    def targets(self, qpos: np.ndarray, angles: list[float], action: np.ndarray) -> list[float]:
        """Return the targets of the joints that move and turn the hand by its share of an action.

        Args:
            qpos: Where all of the robot's joints are (d,).
            angles: The same.
            action: The whole action (k,).
        """
        if not self._follow(*self._arm, qpos, action[self._share], self._angles):
            return [angles[k] for k in self._indices]
        found = self._angles.tolist()
        return [found[k] for k in self._found]


class _Targets:
    """Joints' targets, and what `get_state` and whoever converts trajectories reads of the controllers."""

    def __init__(self, controllers: list[PDJointPosController]) -> None:
        joints = [joint._objs[0] for controller in controllers for joint in controller.joints]
        self._set = [joint.set_drive_target for joint in joints]
        self._indices = np.concatenate([c.active_joint_indices.numpy() for c in controllers]).astype(np.intp)
        # One tensor each for all steps: to make them anew costs more than to set the joints.
        start, target = (torch.zeros((1, len(joints))) for _ in range(2))
        self._start, self._target = start.numpy()[0], target.numpy()[0]
        counts = [len(controller.joints) for controller in controllers]
        self._parts = list(zip(controllers, start.split(counts, 1), target.split(counts, 1), strict=True))

    def set(self, qpos: np.ndarray, target: list[float]) -> None:
        """Set the targets (k,) of the joints of a robot that is at `qpos` (d,)."""
        for controller, before, after in self._parts:
            controller._step = 0
            controller._start_qpos, controller._target_qpos = before, after
        qpos.take(self._indices, out=self._start, mode="clip")  # with "raise" it would be copied
        self._target[:] = target
        for give, value in zip(self._set, target, strict=True):
            give(value)


def _row(pose: sapien.Pose) -> np.ndarray:
    return np.array([pose.__getstate__()], np.float32)
