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
_GRASP_N, _GRASP_DEG = 0.5, 85  # as in `is_grasping`
# Inverse kinematics: ManiSkill's goes a tenth of the way to the goal a step, until 1e-4 are left.
_BOLD, _POSE_TOLERANCE = 0.5, 1e-6


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
        self._bodies = [actor._bodies[0] for actor in actors]
        self._centers = [sapien.Pose(center) for center in centers]
        self._links = set() if env.agent is None else {id(link._objs[0]) for link in env.agent.robot.links}
        self._touching: dict[int, list] = {}
        self._fingers, self._opening = None, ()
        for known, opening in ((Panda, (1, -1)), (Fetch, (-1, 1))):
            if env.agent is not None and type(env.agent).is_grasping is known.is_grasping:
                self._fingers = [env.agent.finger1_link._objs[0], env.agent.finger2_link._objs[0]]
                self._opening = opening

    def refresh(self) -> None:
        """Forget the contacts: the simulator has moved on."""
        self._touching = {}

    def poses(self) -> np.ndarray:
        """Return the actors' poses (1, n, 7): position (m), quaternion wxyz; world."""
        rows = [entity.pose.__getstate__() for entity in self._entities]
        return np.array(rows, np.float32).reshape(1, len(rows), 7)

    def pose(self, row: int) -> np.ndarray:
        """Return the pose (1, 7) of a thing's box centre, with the orientation of its actor."""
        return _row(self._entities[row].pose * self._centers[row])

    def turned(self, row: int, direction: np.ndarray) -> np.ndarray:
        """Return where (1, 3) a direction (3,) of a thing's actor points in the world."""
        return (self._entities[row].pose.to_transformation_matrix()[:3, :3] @ direction)[None]

    def speeds(self, row: int) -> tuple[np.float32, np.float32]:
        """Return the linear (m/s) and angular (rad/s) speed of a thing."""
        body = self._bodies[row]
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
        return all(self._meet(self._bodies[row], finger) for finger in self._fingers)

    @staticmethod
    def _meet(one: Any, other: Any) -> bool:
        """Return whether the boxes around two bodies meet."""
        low, high = one.get_global_aabb_fast().tolist()
        least, most = other.get_global_aabb_fast().tolist()
        return all(least[k] <= high[k] + _MARGIN_M and most[k] >= low[k] - _MARGIN_M for k in (0, 1, 2))

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
        """Return the force (1, 3) (N) of other actors on a thing."""
        bodies = [other._bodies[0] for other in others]
        near = {id(body) for body in bodies if self._meet(self._bodies[row], body)}
        return self._force(row, near)[None] if near else np.zeros((1, 3), np.float32)

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
            self._touching[row], mine = [], self._bodies[row]
            for contact in self._env.scene.px.get_contacts():
                first, second = contact.bodies
                if first is mine:
                    self._touching[row].append((contact, second, 1))
                elif second is mine:
                    self._touching[row].append((contact, first, -1))
        return self._touching[row]


class DirectDrive:
    """ManiSkill's controllers of joints and hand on the CPU; other controllers do as they always do."""

    def __init__(self, agent: BaseAgent) -> None:
        """Look at the controllers that the agent has now."""
        self.controller = agent.controller
        self.foreign: list[tuple[slice, BaseController]] = []
        """Those that ManiSkill drives itself, with their share of the action."""
        self._tips: list[tuple[slice, _Tip]] = []
        children, joints = [], []
        if type(self.controller) is CombinedController:
            for name, child in self.controller.controllers.items():
                share = slice(*self.controller.action_mapping[name])
                children.append(child)
                if _Joints.fits(child):
                    joints.append((share, child))
                elif _Tip.fits(child):
                    self._tips.append((share, _Tip(child)))
                else:
                    self.foreign.append((share, child))
        self._joints = _Joints(joints) if joints else None
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

    def set_action(self, action: torch.Tensor, numbers: np.ndarray) -> None:
        """Give the controllers an action (1, k), whose numbers are (k,), as `controller.set_action` does."""
        if self._joints is None and not self._tips:
            self.controller.set_action(action)
            return
        if self._joints is not None:
            self._joints.drive(numbers)
        for share, tip in self._tips:
            tip.drive(numbers[share])
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
        controllers = [controller for _, controller in parts]
        self._robot = controllers[0].articulation._objs[0]
        self._targets = _Targets(controllers)
        # Of every joint: which it is, whose angle and which number of the action its target comes from, and how:
        # target = (angle * delta + middle + half * action) * factor + offset, the last two where joints are mimicked.
        rows = [np.concatenate(column) for column in zip(*(_columns(*part) for part in parts), strict=True)]
        self._indices, self._source, self._number = (row.astype(np.int64) for row in rows[:3])
        self._low, self._high, self._delta, self._middle, self._half, self._factor, self._offset = (
            row.astype(np.float32) for row in rows[3:]
        )
        self._mimics = bool((self._factor != 1).any() or self._offset.any())

    def drive(self, action: np.ndarray) -> None:
        """Set the joints' targets from the whole action (k,)."""
        qpos = self._robot.qpos
        target = action[self._number]
        np.maximum(target, self._low, out=target)
        np.minimum(target, self._high, out=target)
        target *= self._half
        target += self._middle
        target += qpos[self._source] * self._delta
        if self._mimics:
            target = target * self._factor + self._offset
        self._targets.set(qpos[self._indices], target)


def _columns(share: slice, controller: PDJointPosController) -> list[np.ndarray]:
    """Return what `_Joints` keeps of each of a controller's joints, ten arrays (k,)."""
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
    scale = np.zeros((2, count), np.float32)
    scale[:, control] = middle, half
    delta = np.full(count, float(controller.config.use_delta))
    return [indices, indices[source], number[source], np.full(count, -bound), np.full(count, bound), delta,
            *scale[:, source], factor, offset]  # fmt: skip


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
        return plain and controller.config.frame == frames[type(controller)]

    def __init__(self, controller: PDEEPosController) -> None:
        self._controller = controller
        self._robot = controller.articulation._objs[0]
        self._targets = _Targets([controller])
        self._indices = controller.active_joint_indices.numpy()
        self._root, self._tip = controller.root_link._objs[0], controller.ee_link._objs[0]
        low, high = controller.action_space_low.numpy()[:3], controller.action_space_high.numpy()[:3]
        self._scale = 0.5 * (high + low), 0.5 * (high - low)
        self._turn = controller.config.rot_lower if type(controller) is PDEEPoseController else None
        kinematics = controller.kinematics
        self._known = kinematics.pmodel_active_joint_indices.numpy()
        self._solved = kinematics.pmodel_controlled_joint_indices.numpy()
        self._mask = kinematics.qmask.numpy()

    def drive(self, action: np.ndarray) -> None:
        """Set the joints' targets to where the hand is moved and turned by an action (3,) or (6,)."""
        here = self._root.entity_pose.inv() * self._tip.entity_pose
        move = self._scale[0] + self._scale[1] * np.minimum(np.maximum(action[:3], -1), 1)
        quat = here.q
        if self._turn is not None:
            angles = action[3:].tolist()
            scale = self._turn / max(math.hypot(*angles), 1.0)
            quat = (sapien.Pose(q=_turned(*(scale * angle / 2 for angle in angles))) * sapien.Pose(q=quat)).q
        qpos, goal = self._robot.qpos, sapien.Pose(here.p + move, quat)
        known = qpos[self._known]
        solution, found, _ = self._solve(known, goal, eps=_POSE_TOLERANCE, dt=_BOLD, max_iterations=30)
        if not found:
            solution, found, _ = self._solve(known, goal, max_iterations=100)
        start = qpos[self._indices]
        target = solution[self._solved].astype(np.float32) if found else start
        self._targets.set(start, target)

    def _solve(self, qpos: np.ndarray, goal: sapien.Pose, **options: float) -> tuple[np.ndarray, bool, Any]:
        kinematics = self._controller.kinematics
        return kinematics.pmodel.compute_inverse_kinematics(
            kinematics.end_link_idx, goal, initial_qpos=qpos, active_qmask=self._mask, **options
        )


class _Targets:
    """Joints' targets, and what `get_state` and whoever converts trajectories reads of the controllers."""

    def __init__(self, controllers: list[PDJointPosController]) -> None:
        joints = [joint._objs[0] for controller in controllers for joint in controller.joints]
        self._set = [joint.set_drive_target for joint in joints]
        # One tensor each for all steps: to make them anew costs more than to set the joints.
        start, target = (torch.zeros((1, len(joints))) for _ in range(2))
        self._views = start.numpy()[0], target.numpy()[0]
        counts = [len(controller.joints) for controller in controllers]
        self._parts = list(zip(controllers, start.split(counts, 1), target.split(counts, 1), strict=True))

    def set(self, start: np.ndarray, target: np.ndarray) -> None:
        """Set the targets (k,) of joints that are at `start` (k,)."""
        for controller, before, after in self._parts:
            controller._step = 0
            controller._start_qpos, controller._target_qpos = before, after
        self._views[0][:] = start
        self._views[1][:] = target
        for give, value in zip(self._set, target.tolist(), strict=True):
            give(value)


def _turned(x: float, y: float, z: float) -> list[float]:
    """Return the quaternion of the turn about x, after that about y, after that about z, of half angles (rad)."""
    (a, b, c), (d, e, f) = map(math.cos, (x, y, z)), map(math.sin, (x, y, z))
    return [a * b * c - d * e * f, d * b * c + a * e * f, a * e * c - d * b * f, a * b * f + d * e * c]


def _row(pose: sapien.Pose) -> np.ndarray:
    return np.array([pose.__getstate__()], np.float32)
