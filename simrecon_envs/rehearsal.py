"""What a reset has moved is let stand for a moment before the episode begins, without the robot: who falls is told.

Things that were captured standing on each other may tip when they are moved as a whole: where a support is a little
lower they drop on it, and PhysX adds up the forces in another order. One environment on the CPU.
"""

import math
from typing import Any

from simrecon_envs.forgetting import renew_physics

# What stands hardly moves after a fifth of a second, and ever less; what still wobbles after half a second counts as
# fallen. What begins to tip over is slow at first, but gets faster.
_LEAST_S, _MOST_S, _LOOK_S = 0.2, 0.5, 0.05
_CALM_M_S, _CALM_RAD_S = 0.02, 0.2
_STILL_M_S, _STILL_RAD_S = 0.002, 0.02
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
        self._body, self._pose = body, body.entity.pose
        self._speeds = math.inf, math.inf
        self.calm, self.fell = False, False

    def damp(self, rate_per_s: float) -> None:
        self._body.set_linear_damping(rate_per_s)
        self._body.set_angular_damping(rate_per_s)

    def look(self) -> None:
        body, before = self._body, self._speeds
        linear, angular = math.hypot(*body.linear_velocity), math.hypot(*body.angular_velocity)
        slow = linear <= _CALM_M_S and angular <= _CALM_RAD_S
        slower = linear <= max(before[0], _STILL_M_S) and angular <= max(before[1], _STILL_RAD_S)
        self._speeds = linear, angular
        self.calm = body.is_sleeping or (slow and slower)
        moved = self._pose.inv() * body.entity.pose
        turned = 2 * math.acos(min(abs(float(moved.q[0])), 1.0))
        self.fell = math.hypot(*moved.p) > _FELL_M or turned > _FELL_RAD
