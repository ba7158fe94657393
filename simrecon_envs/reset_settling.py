"""What a reset has moved is let stand for a moment before the episode begins, without the robot: who falls is told.

Things that were captured standing on each other may tip when they are moved as a whole: where a support is a little
lower they drop on it, and PhysX adds up the forces in another order. One environment on the CPU.
"""

import math
from typing import Any

import sapien

from simrecon_envs.physics_reset import renew_physics

# What stands hardly moves after a fifth of a second, and ever less; what still wobbles after half a second counts as
# fallen. What begins to tip over is slow at first, but gets faster.
_LEAST_S, _MOST_S, _LOOK_S = 0.2, 0.5, 0.05
_CALM_M_S, _CALM_RAD_S = 0.02, 0.2
_STILL_M_S, _STILL_RAD_S = 0.001, 0.01
# Things rock where a support is not quite level, for a second and more: with this damping for a tenth of it. What tips
# over does so all the same.
_DAMPING_PER_S = 10.0
# Supports are level to 6 mm, which turns a thing on a foot of 7 cm by five degrees.
_FELL_M, _FELL_RAD = 0.01, 0.09


def rehearse(env: Any) -> set[int]:
    """Simulate the things of a `SceneEnv` where they are, and return the ids of those that fell.

    The others stand where they came to rest. The physics engine is a new one afterwards, and everything in it is
    awake. The robot takes no part: where its joints are is not looked at, nor changed.
    """
    scene = env.scene.sub_scenes[0]
    entities = list(scene.entities)
    if env.agent is not None:
        for link in env.agent.robot._objs[0].links:
            link.entity.remove_from_scene()
    placed = env.builder.movable_actors
    starts = [_Start(one.actor._bodies[0]) for one in placed]
    for start in starts:
        start.damp(_DAMPING_PER_S)
    for number in range(round(_MOST_S / _LOOK_S)):
        for _ in range(round(_LOOK_S / scene.timestep)):
            env.scene.px.step()
        for start in starts:
            start.look()
        if (number + 1) * _LOOK_S >= _LEAST_S and all(start.calm or start.fell for start in starts):
            break
    fell = {one.id for one, start in zip(placed, starts, strict=True) if start.fell or not start.calm}
    for start in starts:
        start.damp(0.0)
    renew_physics(env, entities)
    return fell


class _Start:
    """Where a body was when the rehearsal began, and what has become of it."""

    def __init__(self, body: Any) -> None:
        self._body, self._start = body, body.entity.pose
        self._last, self._speeds = self._start, (math.inf, math.inf)
        self.calm, self.fell = False, False

    def damp(self, rate_per_s: float) -> None:
        self._body.set_linear_damping(rate_per_s)
        self._body.set_angular_damping(rate_per_s)

    def look(self) -> None:
        now, before = self._body.entity.pose, self._speeds
        # Between two looks: at a single time step contacts make a thing at rest tremble.
        linear, angular = (way / _LOOK_S for way in _apart(self._last, now))
        slow = linear <= _CALM_M_S and angular <= _CALM_RAD_S
        slower = linear <= max(before[0], _STILL_M_S) and angular <= max(before[1], _STILL_RAD_S)
        self._last, self._speeds = now, (linear, angular)
        self.calm = slow and slower
        moved, turned = _apart(self._start, now)
        self.fell = moved > _FELL_M or turned > _FELL_RAD


def _apart(one: sapien.Pose, other: sapien.Pose) -> tuple[float, float]:
    """Return how far (m) and by which angle (rad) two poses are apart."""
    between = one.inv() * other
    return math.hypot(*between.p), 2 * math.atan2(math.hypot(*between.q[1:]), abs(between.q[0]))
