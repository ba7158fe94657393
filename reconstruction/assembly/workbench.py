"""The scene while it is built: what is placed stands still, one object at a time is let go."""

from dataclasses import dataclass

import numpy as np

from reconstruction.types import ConvexPart, ObjectAsset
from registry.simulation import TIMESTEP_S, BodySpec, Contact, Physics, pose_change


@dataclass(frozen=True)
class Settled:
    """How an object came to rest after it was let go."""

    pose: np.ndarray  # (4, 4)
    lateral_m: float  # from where it was let go
    drop_m: float
    turned_deg: float
    at_rest: bool
    carriers: tuple[int, ...]  # bodies that push it up, strongest first


def object_spec(
    asset: ObjectAsset,
    parts: tuple[ConvexPart, ...],
    pose: np.ndarray,
    *,
    dynamic: bool,
    fixed_to: int | None = None,
) -> BodySpec:
    """Describe an object to the physics."""
    physics = asset.physics
    return BodySpec(
        id=asset.id,
        name=f"{asset.label}_{asset.id}",
        parts=tuple(np.asarray(p.vertices, np.float64) for p in parts),
        mass_kg=float(physics.mass_kg),
        center_of_mass=np.asarray(physics.center_of_mass, np.float64),
        inertia=np.asarray(physics.inertia, np.float64),
        friction=float(physics.friction),
        restitution=float(physics.restitution),
        world_from_object=pose,
        dynamic=dynamic,
        fixed_to=fixed_to,
    )


class Workbench:
    """A physics scene in which at most one object moves."""

    # Quasi-static: a body sinks at 0.25 m/s and tips slowly instead of bouncing. Only while settling.
    _DAMPING = 40.0

    def __init__(self, base: list[BodySpec]) -> None:
        """Start from the base alone."""
        self.physics = Physics(TIMESTEP_S, 0.0)
        for spec in base:
            self.physics.add(spec)

    def put(self, spec: BodySpec) -> None:
        """Add an object, or replace it (its shape may have changed), held still at its pose."""
        if spec.id in self.physics.specs:
            self.physics.remove(spec.id)
        self.physics.add(spec, kinematic=True)

    def freeze(self, body_id: int, pose: np.ndarray) -> None:
        """Hold an object still at a pose."""
        self.physics.set_kinematic(body_id, True)
        self.physics.set_pose(body_id, pose)

    def probe(self, body_id: int, pose: np.ndarray, tolerance_m: float) -> list[Contact]:
        """Return the object's contacts deeper than the tolerance at a pose, normals pushing it out."""
        physics = self.physics
        physics.set_kinematic(body_id, False)
        physics.set_gravity(body_id, False)
        physics.set_pose(body_id, pose)
        physics.step()
        found = []
        for c in physics.contacts(-tolerance_m):
            if c.first == body_id:
                found.append(c)
            elif c.second == body_id:
                found.append(Contact(body_id, c.first, c.separation_m, -c.normal, c.position, -c.impulse))
        self.freeze(body_id, pose)
        physics.set_gravity(body_id, True)
        return found

    def settle(self, body_id: int, pose: np.ndarray, limit_s: float) -> Settled:
        """Let an object go at a pose until it rests: damped first, then free for a moment."""
        physics = self.physics
        physics.set_kinematic(body_id, False)
        physics.set_pose(body_id, pose)
        at_rest = False
        chunk = round(0.1 / TIMESTEP_S)
        # The free phase shows whether damping alone held the object in place.
        for damping, seconds in ((self._DAMPING, limit_s), (0.0, 0.5)):
            physics.set_damping(body_id, damping, damping)
            at_rest = False
            for _ in range(max(1, round(seconds / 0.1))):
                before = physics.pose(body_id)
                physics.step(chunk)
                moved, turned = pose_change(before, physics.pose(body_id))
                at_rest = moved < 2e-4 and turned < 0.05
                if at_rest or moved > 1.0:
                    break
        end = physics.pose(body_id)
        push: dict[int, float] = {}
        for c in physics.contacts(1e-3):
            if body_id in (c.first, c.second):
                other, sign = (c.second, 1.0) if c.first == body_id else (c.first, -1.0)
                push[other] = push.get(other, 0.0) + sign * float(c.impulse[2])
        carriers = tuple(sorted((i for i in push if push[i] > 0), key=lambda i: (-push[i], i)))
        physics.set_damping(body_id, 0.0, 0.0)
        self.freeze(body_id, end)
        shift = end[:3, 3] - pose[:3, 3]
        lateral = float(np.hypot(shift[0], shift[1]))
        return Settled(end, lateral, float(-shift[2]), pose_change(pose, end)[1], at_rest, carriers)


def make_clear(
    bench: Workbench,
    body_id: int,
    pose: np.ndarray,
    *,
    max_lift_m: float,
    max_shift_m: float,
    tolerance_m: float,
) -> tuple[np.ndarray, bool]:
    """Move an object by as little as possible until nothing is inside it: (pose, whether that worked).

    First along the contact normals, which is the shortest way out; where that runs in circles, over a bounded
    lattice of lifts and sideways shifts, cheapest first.
    """
    out = pose.copy()
    for _ in range(12):
        contacts = bench.probe(body_id, out, tolerance_m)
        if not contacts:
            return out, True
        pushes = np.array([-c.separation_m * c.normal for c in contacts])
        # The same wall pushes at many points: per axis the strongest counts, not the sum.
        step = pushes.max(axis=0, initial=0.0) + pushes.min(axis=0, initial=0.0)
        if np.linalg.norm(step) < 0.25 * tolerance_m:
            break
        step += np.sign(step) * 0.5 * tolerance_m * (np.abs(step) > 1e-9)
        out = out.copy()
        out[:3, 3] += step
        moved = out[:3, 3] - pose[:3, 3]
        if np.hypot(moved[0], moved[1]) > max_shift_m or not -0.002 <= moved[2] <= max_lift_m:
            break
    best, best_depth = pose, np.inf
    for shift in _lattice(max_lift_m, max_shift_m):
        candidate = pose.copy()
        candidate[:3, 3] += shift
        contacts = bench.probe(body_id, candidate, tolerance_m)
        depth = max((-c.separation_m for c in contacts), default=0.0)
        if depth < best_depth:
            best, best_depth = candidate, depth
        if not contacts:
            return candidate, True
    return best, False


def _lattice(max_lift_m: float, max_shift_m: float) -> list[np.ndarray]:
    """Return shifts (3,) within the bounds, cheapest first; lifting costs half, settling undoes it."""
    lifts = np.unique(np.clip([0, 0.002, 0.005, 0.01, 0.015, 0.02, 0.03, 0.045, 0.06], 0, max_lift_m))
    rings = [r for r in (0.0, 0.004, 0.008, 0.015, 0.03) if r <= max_shift_m]
    shifts = []
    for ring in rings:
        for angle in np.arange(8 if ring else 1) * np.pi / 4:
            for lift in lifts:
                shifts.append((ring + 0.5 * lift, ring * np.cos(angle), ring * np.sin(angle), lift))
    shifts.sort(key=lambda s: s[0])
    return [np.array(s[1:]) for s in shifts]
