"""`PhysicsSession`: the physics of a scene as a person plays with it, without a page and without a thread.

Bodies are those of the bundle's report card (`registry.simulation`), except that bodies at rest fall asleep. Poses are
position and quaternion wxyz, float32 (7,), world space.
"""

from collections.abc import Hashable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from registry.errors import UsageError
from registry.geometry import invert_rigid, matrix_from_quat, rigid, transform_points
from registry.simulation import TIMESTEP_S, BodySpec, build_physics

SLEEP_THRESHOLD = 0.005  # m^2/s^2, PhysX's measure of motion; ManiSkill's scenes use the same
_GRAVITY_M_S2 = 9.81
_PULL_RAD_S = 20.0  # natural frequency of the spring of a drag, critically damped: it follows within 0.2 s
_MOST_PULL_M_S2 = 60.0  # a grabbed object pushes others with at most six times its weight
_GRABBED_DAMPING = 4.0  # 1/s, angular: a grabbed object stops swinging
_SHOWN_M, _SHOWN_RAD = 1e-4, 1e-3  # smaller motion of an awake body is not reported
_REST_M, _REST_RAD = 1e-5, 1e-4  # that of a body that has fallen asleep; woken bodies settle by less
_LOST_M = 5.0  # below the lowest body of the start: an object that falls this deep returns


@dataclass
class _Grab:
    """A spring between a point of an object and the pointer."""

    body: int
    at: np.ndarray  # (3,) object space
    target: np.ndarray  # (3,) world


class PhysicsSession:
    """Bodies of a scene that fall, and that can be dragged, pushed and lifted.

    Attributes:
        movable: Ids of the bodies that move.
        time_s: Simulated time since the last reset.
    """

    def __init__(self, specs: Iterable[BodySpec], start: Mapping[int, np.ndarray] | None = None) -> None:
        """Build the scene, everything asleep at its start pose.

        Args:
            specs: All bodies, floor and walls included.
            start: `world_from_object` (4, 4) by id where it differs from the spec's.
        """
        start = start or {}
        specs = [replace(s, world_from_object=start.get(s.id, s.world_from_object)) for s in specs]
        self._physics = build_physics(specs, sleep_threshold=SLEEP_THRESHOLD)
        self._entities: dict[int, Any] = {int(entity.name): entity for entity in self._physics.scene.entities}
        self.movable = tuple(spec.id for spec in specs if spec.dynamic and not spec.base)
        self._bodies: dict[int, Any] = {key: _body(self._entities[key]) for key in self.movable}
        self._start = {key: self._entities[key].pose for key in self.movable}
        self._lowest_m = min((float(pose.p[2]) for pose in self._start.values()), default=0.0) - _LOST_M
        self._shown = {key: self.pose(key) for key in self.movable}
        self._grabs: dict[Hashable, _Grab] = {}
        self._behind_s = 0.0
        self.time_s = 0.0
        self._sleep_all()

    # ---- State.

    def pose(self, key: int) -> np.ndarray:
        """Return position and quaternion wxyz of a body, float32 (7,)."""
        pose = self._entities[key].pose
        return np.concatenate([pose.p, pose.q]).astype(np.float32)

    @property
    def at_rest(self) -> bool:
        """Tell whether all bodies sleep and none is grabbed: stepping changes nothing."""
        return not self._grabs and all(body.is_sleeping for body in self._bodies.values())

    @property
    def moving(self) -> tuple[int, ...]:
        """Return the ids of the bodies that are awake."""
        return tuple(key for key, body in self._bodies.items() if not body.is_sleeping)

    def changes(self) -> dict[int, np.ndarray]:
        """Return the poses (7,) of the bodies that moved since the last call, by id.

        A body that falls asleep is reported once more, so that it is shown to 0.01 mm, and then not at all.
        """
        found: dict[int, np.ndarray] = {}
        for key, body in self._bodies.items():
            pose, shown = self.pose(key), self._shown[key]
            most = (_REST_M, _REST_RAD) if body.is_sleeping else (_SHOWN_M, _SHOWN_RAD)
            if _differs(pose, shown, *most):
                found[key] = self._shown[key] = pose
        return found

    # ---- Time.

    def advance(self, seconds: float) -> None:
        """Simulate the whole time steps in `seconds`; the rest is added to the next call."""
        self._behind_s += seconds
        count = int(self._behind_s / TIMESTEP_S + 1e-6)
        self._behind_s -= count * TIMESTEP_S
        self.step(count)

    def step(self, count: int = 1) -> None:
        """Simulate `count` time steps of 1/240 s. Objects that fell out of the scene return to their start."""
        for _ in range(count):
            for grab in self._grabs.values():
                self._pull(grab)
            self._physics.step()
        self.time_s += count * TIMESTEP_S
        for key in self.moving:
            if not self.pose(key)[2] > self._lowest_m:  # also if it is not finite
                self._put(key, self._start[key])

    def wake(self) -> None:
        """Wake all bodies: those without support begin to fall."""
        for body in self._bodies.values():
            body.wake_up()

    def reset(self) -> None:
        """Return every body to its start pose, asleep, and end all drags."""
        for who in list(self._grabs):
            self.release(who)
        for key in self.movable:
            self._put(key, self._start[key])
        self._sleep_all()
        self.time_s = self._behind_s = 0.0

    # ---- Acts.

    def grab(self, who: Hashable, key: int, point: np.ndarray) -> None:
        """Begin a drag: attach a spring to a body at a world point (3,); `who` names the pointer.

        Raises:
            UsageError: The body does not move.
        """
        self._check_movable(key)
        self.release(who)
        at = transform_points(invert_rigid(self._matrix(key)), np.asarray(point, np.float64)[None])[0]
        self._grabs[who] = _Grab(key, at, np.asarray(point, np.float64))
        self._bodies[key].set_angular_damping(_GRABBED_DAMPING)

    def drag(self, who: Hashable, target: np.ndarray) -> None:
        """Move the pointer to a world point (3,); ignored if nothing is grabbed."""
        if who in self._grabs:
            self._grabs[who].target = np.asarray(target, np.float64)

    def release(self, who: Hashable) -> None:
        """End a drag; the body keeps its velocity."""
        grab = self._grabs.pop(who, None)
        if grab is not None and all(other.body != grab.body for other in self._grabs.values()):
            self._bodies[grab.body].set_angular_damping(0.0)

    def push(self, key: int, point: np.ndarray, direction: np.ndarray, speed_m_s: float) -> None:
        """Push a body at a world point (3,) along a direction (3,), with the impulse of its mass at a speed.

        Raises:
            UsageError: The body does not move.
        """
        self._check_movable(key)
        body = self._bodies[key]
        along = np.asarray(direction, np.float64) / max(float(np.linalg.norm(direction)), 1e-9)
        body.wake_up()
        body.add_force_at_point(_floats(body.mass * speed_m_s * along), _floats(point), "impulse")

    def lift(self, key: int, height_m: float) -> None:
        """Move a body up and let go: it drops. All others wake, as it may have carried them.

        Raises:
            UsageError: The body does not move.
        """
        self._check_movable(key)
        pose = self._entities[key].pose
        pose.set_p(pose.p + _floats([0, 0, height_m]))
        self._put(key, pose)
        self.wake()

    def place(self, key: int, world_from_object: np.ndarray) -> None:
        """Set the pose (4, 4) of any object, at rest; the others wake, as it may have carried them."""
        pose = np.asarray(world_from_object, np.float64)
        self._physics.set_pose(key, pose)
        self.wake()

    # ---- Inside.

    def _check_movable(self, key: int) -> None:
        if key not in self._bodies:
            spec = self._physics.specs.get(key)
            name = f"object {key}" if spec is None else spec.name.replace("_", " ")
            raise UsageError(
                f"{name} does not move: it is fixed in this scene. `movable` in the overrides frees it"
            )

    def _matrix(self, key: int) -> np.ndarray:
        pose = self._entities[key].pose
        return rigid(matrix_from_quat(np.asarray(pose.q, np.float64)), np.asarray(pose.p, np.float64))

    def _pull(self, grab: _Grab) -> None:
        """Apply the force of a critically damped spring at the grabbed point; it also carries the weight."""
        body, world_from_object = self._bodies[grab.body], self._matrix(grab.body)
        point = transform_points(world_from_object, grab.at[None])[0]
        middle = transform_points(world_from_object, np.asarray(body.cmass_local_pose.p, np.float64)[None])[0]
        velocity = body.get_linear_velocity() + np.cross(body.get_angular_velocity(), point - middle)
        pull = _PULL_RAD_S**2 * (grab.target - point) - 2 * _PULL_RAD_S * velocity
        pull *= min(1.0, _MOST_PULL_M_S2 / max(float(np.linalg.norm(pull)), 1e-9))
        pull[2] += _GRAVITY_M_S2
        body.wake_up()
        body.add_force_at_point(_floats(body.mass * pull), _floats(point))

    def _put(self, key: int, pose: Any) -> None:
        self._entities[key].set_pose(pose)
        self._physics.stop(key)

    def _sleep_all(self) -> None:
        for body in self._bodies.values():
            body.put_to_sleep()


def _body(entity: Any) -> Any:
    """Return the rigid body of an entity."""
    return next(part for part in entity.components if hasattr(part, "is_sleeping"))


def _floats(values: Any) -> Any:
    return np.asarray(values, np.float32)


def _differs(pose: np.ndarray, shown: np.ndarray, most_m: float, most_rad: float) -> bool:
    moved = float(np.linalg.norm(pose[:3] - shown[:3]))
    # Differences are accurate for small angles; arccos of float32 quaternions is not.
    turned = 2 * float(min(np.linalg.norm(pose[3:] - shown[3:]), np.linalg.norm(pose[3:] + shown[3:])))
    return not (moved < most_m and turned < most_rad)  # also if it is not finite
