"""A script that picks up the target from above: for demonstrations, and to show that a scene's task can be
done.
"""

import numpy as np

_HOVER_M = 0.09
_GRIP_DEPTH_M = 0.032  # how far the fingertips go below the target's top
_TIP_CLEARANCE_M = 0.012  # how far they stay above what it stands on
_LIFT_M = 0.22
_MAX_SHARE = 0.35  # of the largest step that the controller takes
_POSITION_STEP_M, _ROTATION_STEP_RAD = 0.1, 0.1  # what an action of 1 means to pd_ee_delta_pose
_CLOSE_STEPS = 8
_LOWER_PATIENCE_STEPS = 35


class PickScript:
    """Reaches over the target, goes down, grips, lifts and holds; one action a control step.

    For one environment on the CPU, with a robot that has the control mode `pd_ee_delta_pose` of ManiSkill.
    """

    def __init__(self, env: object) -> None:
        """Start at rest; `env` is a `SceneEnv` with a target."""
        self._env = env
        self._phase = "reach"
        self._waited = 0
        self._lift_goal: np.ndarray | None = None
        # Fetch: arm (6), gripper (1), head pan, head tilt, torso lift, then the base forward and turning.
        self._torso = 9 if "torso_lift_joint" in getattr(env.agent, "body_joint_names", ()) else None

    @property
    def phase(self) -> str:
        """Return "reach", "lower", "grip" or "lift"."""
        return self._phase

    def action(self) -> np.ndarray:
        """Return the next action (a,) in [-1, 1]."""
        env, target = self._env, self._env.target
        tip = env.agent.tcp.pose.p[0].cpu().numpy().astype(np.float64)
        place = env.target_position[0].cpu().numpy().astype(np.float64)
        half_height = (target.top_m - target.bottom_m) / 2
        grip_height = place[2] + max(half_height - _GRIP_DEPTH_M, _TIP_CLEARANCE_M - half_height)
        turn = self._turn()
        if self._phase == "reach":
            goal = np.array([*place[:2], place[2] + half_height + _HOVER_M])
            if np.linalg.norm(goal - tip) < 0.012 and abs(turn) < 0.06:
                self._phase = "lower"
        elif self._phase == "lower":
            goal = np.array([*place[:2], grip_height])
            self._waited += 1
            # A short gripper meets the target's top with its palm first: then that is deep enough.
            if np.linalg.norm(goal - tip) < 0.008 or self._waited > _LOWER_PATIENCE_STEPS:
                self._phase, self._waited = "grip", 0
        elif self._phase == "grip":
            goal, turn = tip, 0.0
            self._waited += 1
            if self._waited > _CLOSE_STEPS:
                self._phase, self._lift_goal = "lift", tip + np.array([0, 0, _LIFT_M])
        else:
            goal, turn = self._lift_goal, 0.0
        move = np.clip((goal - tip) / _POSITION_STEP_M, -_MAX_SHARE, _MAX_SHARE)
        action = np.zeros(env.single_action_space.shape, np.float32)
        action[:3] = self._to_root(move)
        # ManiSkill scales rotations by its `rot_lower`, which is negative: +1 means -0.1 rad.
        action[5] = -np.clip(turn / _ROTATION_STEP_RAD, -1, 1)
        if self._torso is not None:
            # The arm alone does not get far up or down, nor forward with the hand turned down.
            action[self._torso] = np.clip((goal - tip)[2] / _POSITION_STEP_M, -_MAX_SHARE, _MAX_SHARE)
            if self._phase in ("reach", "lower"):
                action[self._torso + 1] = np.clip(2.0 * self._to_root(goal - tip)[0], -0.15, 0.15)
        action[6] = 1.0 if self._phase in ("reach", "lower") else -1.0
        return action

    def _turn(self) -> float:
        """Return by which angle about +z the gripper must turn to close along the target's narrow side."""
        closing = self._env.agent.tcp.pose.to_transformation_matrix()[0, :2, 1].cpu().numpy()
        error = self._env.target.grip_yaw_rad - np.arctan2(closing[1], closing[0])
        # A gripper that is turned by half a turn closes the same way.
        return float((error + np.pi / 2) % np.pi - np.pi / 2)

    def _to_root(self, vector: np.ndarray) -> np.ndarray:
        yaw = self._env.placement.yaw_rad
        c, s = np.cos(yaw), np.sin(yaw)
        return np.array([c * vector[0] + s * vector[1], -s * vector[0] + c * vector[1], vector[2]])
