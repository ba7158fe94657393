"""Settle check after pose randomization: simulate the moved objects for a moment and return the ids that fall.

Objects that were captured on top of each other may tip when they are moved as a group: the support is a little lower at
the new place, and PhysX adds up forces in another order. One environment on the CPU, without the robot.
"""

import math
from typing import Any

import sapien

from simrecon_envs.physics_reset import renew_physics

# Simulated time (minimum, maximum) and sampling interval. Stable objects are calm and slowing after the minimum; an
# object that still moves after the maximum counts as fallen. One that starts to tip is slow, but gets faster.
_LEAST_S, _MOST_S, _SAMPLE_S = 0.2, 0.5, 0.05
_CALM_M_S, _CALM_RAD_S = 0.02, 0.2
_STILL_M_S, _STILL_RAD_S = 0.001, 0.01
# On uneven supports objects rock for more than a second; this damping reduces that tenfold and does not stop tipping.
_DAMPING_PER_S = 10.0
# Larger changes of pose are a fall. Supports are level to 6 mm: 5 degrees for an object with a base of 7 cm.
_FELL_M, _FELL_RAD = 0.01, 0.09


def settle_check(env: Any) -> set[int]:
    """Simulate the objects of a `SceneEnv` at their poses and return the ids of those that fell.

    The others keep the poses where they came to rest. Afterwards the PhysX scene is new and all objects are awake. The
    robot is removed meanwhile and does not change.
    """
    scene = env.scene.sub_scenes[0]
    entities = list(scene.entities)
    if env.agent is not None:
        for link in env.agent.robot._objs[0].links:
            link.entity.remove_from_scene()
    placed = env.builder.movable_actors
    motions = [_Motion(one.actor._bodies[0]) for one in placed]
    for motion in motions:
        motion.damp(_DAMPING_PER_S)
    for number in range(round(_MOST_S / _SAMPLE_S)):
        for _ in range(round(_SAMPLE_S / scene.timestep)):
            env.scene.px.step()
        for motion in motions:
            motion.sample()
        if (number + 1) * _SAMPLE_S >= _LEAST_S and all(motion.calm or motion.fell for motion in motions):
            break
    fell = {one.id for one, motion in zip(placed, motions, strict=True) if motion.fell or not motion.calm}
    for motion in motions:
        motion.damp(0.0)
    renew_physics(env, entities)
    return fell


class _Motion:
    """Motion of a body since the start of the settle check."""

    def __init__(self, body: Any) -> None:
        self._body, self._start = body, body.entity.pose
        self._last, self._speeds = self._start, (math.inf, math.inf)
        self.calm, self.fell = False, False

    def damp(self, rate_per_s: float) -> None:
        self._body.set_linear_damping(rate_per_s)
        self._body.set_angular_damping(rate_per_s)

    def sample(self) -> None:
        now, before = self._body.entity.pose, self._speeds
        # Mean speed of the interval: contacts add jitter to the velocities of single time steps.
        linear, angular = (way / _SAMPLE_S for way in _apart(self._last, now))
        slow = linear <= _CALM_M_S and angular <= _CALM_RAD_S
        slower = linear <= max(before[0], _STILL_M_S) and angular <= max(before[1], _STILL_RAD_S)
        self._last, self._speeds = now, (linear, angular)
        self.calm = slow and slower
        moved, turned = _apart(self._start, now)
        self.fell = moved > _FELL_M or turned > _FELL_RAD


def _apart(one: sapien.Pose, other: sapien.Pose) -> tuple[float, float]:
    """Return the distance (m) and the angle (rad) between two poses."""
    between = one.inv() * other
    return math.hypot(*between.p), 2 * math.atan2(math.hypot(*between.q[1:]), abs(between.q[0]))
