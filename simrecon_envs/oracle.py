"""Scripted expert: solves tasks for demonstrations, and to show that a task is feasible in a scene.

The `script` of a task is a sequence of `Hand` movements. `Oracle` runs it and returns actions.
"""

import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from registry import UsageError
from simrecon_envs.arrays import numpy
from simrecon_envs.grasps import Grasp

CONTROL_MODE = "pd_ee_delta_pose"
HAND_BEHIND_M = 0.052  # from an object's outline to the closed fingers before a push
_HOVER_M = 0.09  # above an object's top before lowering the hand
_GRIP_DEPTH_M = 0.032  # of the fingertips below the target's top
_TIP_CLEARANCE_M = 0.012  # of the fingertips above the support
_MAX_SHARE = 0.35  # of the controller's maximum step
_POSITION_STEP_M, _ROTATION_STEP_RAD = 0.1, 0.1  # of pd_ee_delta_pose for an action of 1
_CLOSE_STEPS, _OPEN_STEPS = 8, 6
_PATIENCE_STEPS = 60  # after which a movement is given up
_SWING_RAD = 0.35  # maximum turn about the robot's foot per waypoint
_GRIPS = 3  # grasps that are tried
_LOWER_PATIENCE_STEPS = 35
_TURN_RAD = 0.06  # yaw tolerance
_PUSH_SHARE = 0.12  # of the controller's maximum step
_LEVER = 1.4  # maximum height of a push, relative to half the object's width
_TORSO, _FORWARD, _TURN = 9, 10, 11  # indices in Fetch's action

Goal = Callable[[], np.ndarray]


class Oracle:
    """Scripted expert for the task of an environment. Create a new one after every reset.

    Requires one environment on the CPU and ManiSkill's control mode `pd_ee_delta_pose`.
    """

    def __init__(self, env: Any) -> None:
        """Start the script in a `SceneEnv` or a wrapper of one.

        Raises:
            UsageError: There is no task, more than one environment, or another control mode.
        """
        scene = env.unwrapped
        if scene.task_object is None:
            why = scene.task_note or "task none"
            raise UsageError(f"scene {scene.scene_id}: there is no task to do: {why}")
        if scene.num_envs != 1 or scene.control_mode != CONTROL_MODE:
            raise UsageError(
                f"the oracle needs num_envs=1 and control_mode={CONTROL_MODE!r}, this environment has "
                f"{scene.num_envs} and {scene.control_mode!r}"
            )
        self.hand = Hand(scene)
        self._actions = scene.task_object.script(self.hand)

    def action(self) -> np.ndarray:
        """Return the next action (a,) in [-1, 1]; after the end of the script, one that holds the pose."""
        action = next(self._actions, None)
        return self.hand.step(self.hand.tip(), 0.0, base=False) if action is None else action

    def actions(self) -> Iterator[np.ndarray]:
        """Yield actions until the script ends."""
        yield from self._actions


class Hand:
    """Movements for scripts; each is a generator of actions."""

    def __init__(self, env: Any) -> None:
        """Start with an open hand at its current pose."""
        self._env = env
        self._open = True
        self._opening: float | None = None  # (m) of the open hand; None for the maximum
        self.phase = "start"
        gripper = env.agent.controller.controllers.get("gripper")
        self._travel_m = 0.04 if gripper is None else float(gripper.config.upper - gripper.config.lower)
        # Fetch: arm (6), gripper (1), head pan, head tilt, torso lift, then the base forward and turning.
        self._fetch = "torso_lift_joint" in getattr(env.agent, "body_joint_names", ())

    # ---- State.

    def tip(self) -> np.ndarray:
        """Return the tool centre point (3,), world."""
        return numpy(self._env.measures.tcp)[0, :3].astype(np.float64)

    def place(self, key: int) -> np.ndarray:
        """Return the box centre (3,) of an object, world."""
        return numpy(self._env.measures.position(key))[0].astype(np.float64)

    # ---- Movements.

    def go(self, goal: Goal, *, within_m: float = 0.012, yaw: Callable[[], float] | None = None, base: bool = True,
           patience: int = _PATIENCE_STEPS, share: float = _MAX_SHARE) -> Iterator[np.ndarray]:  # fmt: skip
        """Move the fingertips to `goal()`, closing direction `yaw()`; give up after `patience` steps."""
        for _ in range(patience):
            turn = 0.0 if yaw is None else self._turn(yaw())
            if np.linalg.norm(goal() - self.tip()) < within_m and abs(turn) < _TURN_RAD:
                return
            towards, swing = self._around(goal())
            # Without a yaw, the wrist turns with the arm, so that it stays within its limits.
            yield self.step(towards, swing * share if yaw is None else turn, base=base, share=share)

    def rise(self, height_m: float) -> Iterator[np.ndarray]:
        """Raise the hand vertically to a world height, if it is lower, to clear obstacles."""
        if self.tip()[2] < height_m - 0.02:
            above = np.array([*self.tip()[:2], height_m])
            yield from self.go(lambda: above, within_m=0.02, base=False, patience=25)

    def close(self) -> None:
        """Close the fingers during the next movement: a closed hand needs less space."""
        self._open, self._opening = False, None

    def grip(self, key: int) -> Iterator[np.ndarray]:
        """Reach above an object, lower the hand to a grasp and close the fingers; try the next grasp if it fails."""
        for grasp in (self._env.facts.targets[key].grasps or (self._across(key),))[:_GRIPS]:
            yield from self._grip(key, grasp)
            if bool(self._env.measures.held(key)):
                return
        self._opening = None

    def _grip(self, key: int, grasp: Grasp) -> Iterator[np.ndarray]:
        facts, measures = self._env.facts, self._env.measures
        top = facts.height_m(key) / 2 + _HOVER_M

        def turned() -> float:
            return float(measures.yaw(key))

        def there() -> np.ndarray:
            c, s = math.cos(turned()), math.sin(turned())
            x, y, z = grasp.offset
            return self.place(key) + np.array([c * x - s * y, s * x + c * y, z])

        def over() -> np.ndarray:
            return np.array([*there()[:2], self.place(key)[2] + top])

        self._open, self._opening, self.phase = True, grasp.opening_m, "reach"
        yield from self.rise(float(over()[2]))
        yield from self.go(over, yaw=lambda: grasp.yaw_rad + turned())
        self.phase = "lower"
        # Fix the goal now: the fingers may move the object during the approach.
        goal, yaw = there(), grasp.yaw_rad + turned()
        yield from self.go(lambda: goal, within_m=0.005, yaw=lambda: yaw, patience=_LOWER_PATIENCE_STEPS)
        self.phase, self._open = "grip", False
        yield from self.wait(_CLOSE_STEPS + 1)

    def _across(self, key: int) -> Grasp:
        """Return a grasp across the whole width of an object without known grasps."""
        facts = self._env.facts
        target, half = facts.targets[key], facts.height_m(key) / 2
        depth = max(half - _GRIP_DEPTH_M, _TIP_CLEARANCE_M - half)
        opening = facts.traits.hand.opening_m
        return Grasp(np.array([0, 0, depth]), target.grip_yaw_rad, target.grip_width_m, opening, 1.0)

    def lift(self, height_m: float) -> Iterator[np.ndarray]:
        """Raise the hand vertically by a height."""
        self.phase = "lift"
        goal = self.tip() + _up(height_m)
        yield from self.go(lambda: goal, base=False, within_m=0.02, patience=30)

    def carry(self, key: int, goal: Goal, over_m: float, above_m: float) -> Iterator[np.ndarray]:
        """Carry the held object until its centre is above `goal()`, then lower it to just above the goal."""
        self.phase = "carry"

        def tip_for(height_m: float) -> Goal:
            return lambda: goal() + _up(height_m) + self.tip() - self.place(key)

        up = max(goal()[2] + over_m - self.place(key)[2], 0.0)
        if up > 0.02:
            yield from self.lift(up)
        # Keep the height: a slanted descent could hit obstacles on the way.
        high = max(float(self.place(key)[2]), float(goal()[2]) + over_m)
        yield from self.go(
            lambda: tip_for(high - float(goal()[2]))(), within_m=0.02, base=True, share=0.25, patience=90
        )
        self.phase = "lower"
        if high > goal()[2] + over_m + 0.03:
            yield from self.go(tip_for(over_m), within_m=0.015, base=True, share=0.25)
        yield from self.go(tip_for(above_m / 2), within_m=0.008, base=False, share=0.12, patience=50)
        yield from self.wait(4)

    def let_go(self) -> Iterator[np.ndarray]:
        """Open the fingers and raise the hand."""
        self._open, self._opening, self.phase = True, None, "let go"
        yield from self.wait(_OPEN_STEPS)
        yield from self.lift(0.13)

    def push(self, key: int, goal: Goal, within_m: float) -> Iterator[np.ndarray]:
        """Push an object along its support with closed fingers, from behind, until its centre is at the goal."""
        self._open, self.phase = False, "behind"
        facts = self._env.facts
        half, radius = facts.height_m(key) / 2, facts.radius_m(key)
        way = goal() - self.place(key)
        along = np.array([*way[:2], 0.0]) / max(np.linalg.norm(way[:2]), 1e-6)
        low = min(-0.2 * half, half - 0.02) if half > 0.02 else 0.0
        # Push low enough that friction at its foot cannot tip it over.
        low = min(low, max(_LEVER * facts.targets[key].grip_width_m / 2, 0.03) - half)
        low = max(low, _TIP_CLEARANCE_M + 0.006 - half)
        yaw = float(np.arctan2(along[0], -along[1]))  # the fingers side by side, across the way
        behind = self.place(key) - along * (radius + HAND_BEHIND_M)
        yield from self.rise(float(behind[2]) + half + _HOVER_M)
        yield from self.go(lambda: behind + _up(half + _HOVER_M), yaw=lambda: yaw)
        yield from self.go(lambda: behind + _up(low), yaw=lambda: yaw, within_m=0.01, patience=40)
        self.phase = "push"
        for _ in range(140):
            left = goal() - self.place(key)
            left[2] = 0.0
            if np.linalg.norm(left) < within_m or left @ along < 0:
                break
            way = left / np.linalg.norm(left)
            aside = self.tip() - self.place(key)
            across = aside - (aside @ way) * way
            ahead = self.tip() + 0.04 * way - [across[0], across[1], 0]
            ahead[2] = self.place(key)[2] + low
            yield self.step(ahead, self._turn(yaw), base=False, share=_PUSH_SHARE)
        back = self.tip() - 0.03 * along
        yield from self.go(lambda: back, base=False, patience=8)

    def wait(self, steps: int) -> Iterator[np.ndarray]:
        """Hold the pose."""
        still = self.tip()
        for _ in range(steps):
            yield self.step(still, 0.0, base=False)

    def drive(self, base: Callable, goal: Goal, within_m: float) -> Iterator[np.ndarray]:
        """Turn towards a point (2,) of the floor and drive the base to it."""
        self.phase = "drive"
        for _ in range(160):
            _, ahead, left = self._on_floor(base, goal())
            if np.linalg.norm(left) < within_m:
                return
            off = _signed_angle(ahead, left)
            speed = np.clip(1.5 * np.linalg.norm(left), 0, 0.5) * max(np.cos(off), 0) ** 4
            yield self._wheels(speed, np.clip(1.0 * off, -0.5, 0.5))

    def face(self, base: Callable, goal: Goal) -> Iterator[np.ndarray]:
        """Turn the base to face a point (2,) of the floor."""
        for _ in range(80):
            _, ahead, left = self._on_floor(base, goal())
            off = _signed_angle(ahead, left)
            if abs(off) < 0.1:
                return
            yield self._wheels(0.0, np.clip(1.0 * off, -0.5, 0.5))

    # ---- Actions.

    def step(
        self, goal: np.ndarray, turn: float, *, base: bool = True, share: float = _MAX_SHARE
    ) -> np.ndarray:
        """Return the action (a,) that moves the fingertips towards `goal` (3,) and turns by up to `turn` (rad)."""
        tip = self.tip()
        move = np.clip((goal - tip) / _POSITION_STEP_M, -share, share)
        action = np.zeros(self._env.single_action_space.shape, np.float32)
        action[:3] = self._to_root(move)
        # ManiSkill scales rotations by its `rot_lower`, which is negative: +1 means -0.1 rad.
        action[5] = -np.clip(turn / _ROTATION_STEP_RAD, -1, 1)
        action[3:5] = -np.clip(0.5 * self._lean()[:2] / _ROTATION_STEP_RAD, -0.5, 0.5)
        if self._fetch:
            # With the hand pointing down, the arm alone has little vertical and forward range.
            action[_TORSO] = np.clip((goal - tip)[2] / _POSITION_STEP_M, -share, share)
            if base:
                action[_FORWARD] = np.clip(2.0 * self._to_root(goal - tip)[0], -0.15, 0.15)
        action[6] = self._fingers()
        return action

    def _around(self, goal: np.ndarray) -> tuple[np.ndarray, float]:
        """Return the next waypoint (3,) on an arc about a mounted arm's foot, and the turn of a full step (rad).

        The straight line to a goal far aside would cross the robot's foot.
        """
        if self._fetch:
            return goal, 0.0
        here, there = (self._env.placement.to_root(point)[:2] for point in (self.tip(), goal))
        first, last = (float(np.arctan2(p[1], p[0])) for p in (here, there))
        angle = last - first  # never through the rear, where the first joint has its limits
        if abs(angle) < _SWING_RAD:
            return goal, 0.0
        share = _SWING_RAD / abs(angle)
        radius = (1 - share) * float(np.linalg.norm(here)) + share * float(np.linalg.norm(there))
        turn = first + math.copysign(_SWING_RAD, angle)
        local = np.array([radius * math.cos(turn), radius * math.sin(turn), 0.0])
        out = self._env.placement.to_world(local)
        out[2] = goal[2]
        step = _POSITION_STEP_M / max(radius, 0.2)  # turn of the arm in a full step
        return out, math.copysign(step, angle)

    def _fingers(self) -> float:
        if not self._open or self._opening is None:
            return 1.0 if self._open else -1.0
        shut = (self._env.facts.traits.hand.opening_m - self._opening) / 2
        return float(np.clip(1 - 2 * shut / self._travel_m, -1, 1))

    def _wheels(self, forward: float, turn: float) -> np.ndarray:
        action = np.zeros(self._env.single_action_space.shape, np.float32)
        action[6], action[_FORWARD], action[_TURN] = 1.0, forward, turn
        return action

    def _on_floor(self, base: Callable, goal: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        here, ahead = (numpy(x)[0].astype(np.float64) for x in base())
        return here, ahead, goal[:2] - here

    def _turn(self, yaw: float) -> float:
        """Return the rotation (rad) about +z that aligns the closing direction with a yaw."""
        closing = self._env.agent.tcp.pose.to_transformation_matrix()[0, :2, 1].cpu().numpy()
        error = yaw - np.arctan2(closing[1], closing[0])
        # The closing direction is symmetric under half a turn.
        return float((error + np.pi / 2) % np.pi - np.pi / 2)

    def _lean(self) -> np.ndarray:
        """Return the rotation vector (3,), root axes, that makes the gripper point down."""
        pose = self._env.agent.tcp.pose.to_transformation_matrix()[0, :3, :3].cpu().numpy()
        return self._to_root(np.cross(pose[:, 0 if self._fetch else 2], [0.0, 0.0, -1.0]))

    def _to_root(self, vector: np.ndarray) -> np.ndarray:
        yaw = self._env.placement.yaw_rad
        c, s = np.cos(yaw), np.sin(yaw)
        return np.array([c * vector[0] + s * vector[1], -s * vector[0] + c * vector[1], vector[2]])


def _up(height_m: float) -> np.ndarray:
    return np.array([0.0, 0.0, height_m])


def _signed_angle(first: np.ndarray, second: np.ndarray) -> float:
    return float(np.arctan2(first[0] * second[1] - first[1] * second[0], first @ second))
