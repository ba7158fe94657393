"""Physics scene of assembly: placed objects are kinematic, one object at a time is simulated."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from reconstruction.assets.gltf import written_corners
from reconstruction.core.types import ConvexPart, ObjectAsset
from registry.simulation import TIMESTEP_S, BodySpec, Contact, Physics, pose_change

STANDING = 0.7  # least z of the normal of a supporting contact


@dataclass(frozen=True)
class Settled:
    """Result of simulating an object until it rests."""

    pose: np.ndarray  # (4, 4)
    lateral_m: float  # horizontal displacement from the initial pose
    drop_m: float
    turned_deg: float
    at_rest: bool
    carriers: tuple[int, ...]  # ids of bodies that push it up, strongest first
    support: np.ndarray  # (n, 2) world, supporting contact points


def object_spec(
    asset: ObjectAsset,
    parts: tuple[ConvexPart, ...],
    pose: np.ndarray,
    *,
    dynamic: bool,
    fixed_to: int | None = None,
) -> BodySpec:
    """Return the body of an object, with its parts as the bundle stores them."""
    physics = asset.physics
    return BodySpec(
        id=asset.id,
        name=f"{asset.label}_{asset.id}",
        parts=tuple(written_corners(p) for p in parts),
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
    """A physics scene in which at most one object is dynamic."""

    # Quasi-static: while settling, a body falls at 0.25 m/s and tips slowly instead of bouncing.
    _DAMPING = 40.0

    def __init__(self, base: list[BodySpec]) -> None:
        """Start from the base alone."""
        self.physics = Physics(TIMESTEP_S, 0.0)
        for spec in base:
            self.physics.add(spec)

    def put(self, spec: BodySpec) -> None:
        """Add an object or replace it, as a kinematic body."""
        if spec.id in self.physics.specs:
            self.physics.remove(spec.id)
        self.physics.add(spec, kinematic=True)

    def freeze(self, body_id: int, pose: np.ndarray) -> None:
        """Make an object kinematic at a pose."""
        self.physics.set_kinematic(body_id, True)
        self.physics.set_pose(body_id, pose)

    def probe(self, body_id: int, pose: np.ndarray, tolerance_m: float) -> list[Contact]:
        """Return contacts deeper than the tolerance of an object at a pose; it is `first`, normals push it out."""
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
                # Ids are in the order of when the pair first met; the normal is that of the dynamic body.
                found.append(Contact(body_id, c.first, c.separation_m, c.normal, c.position, c.impulse))
        self.freeze(body_id, pose)
        physics.set_gravity(body_id, True)
        return found

    def settle(self, body_id: int, pose: np.ndarray, limit_s: float) -> Settled:
        """Simulate an object from a pose until it rests, damped for up to `limit_s`, then undamped for up to 0.5 s."""
        physics = self.physics
        physics.set_kinematic(body_id, False)
        physics.set_pose(body_id, pose)
        at_rest = False
        chunk = round(0.1 / TIMESTEP_S)
        # The undamped phase reveals objects that only damping held in place.
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
        points = []
        for c in physics.contacts(1e-3):
            if body_id in (c.first, c.second):
                other, sign = (c.second, 1.0) if c.first == body_id else (c.first, -1.0)
                push[other] = push.get(other, 0.0) + sign * float(c.impulse[2])
                if abs(c.normal[2]) > STANDING:
                    points.append(c.position[:2])
        carriers = tuple(sorted((i for i in push if push[i] > 0), key=lambda i: (-push[i], i)))
        physics.set_damping(body_id, 0.0, 0.0)
        self.freeze(body_id, end)
        shift = end[:3, 3] - pose[:3, 3]
        lateral = float(np.hypot(shift[0], shift[1]))
        support = np.array(points).reshape(-1, 2)
        return Settled(end, lateral, float(-shift[2]), pose_change(pose, end)[1], at_rest, carriers, support)


def support_margin(points: np.ndarray, center: np.ndarray) -> float:
    """Return the distance (m) of a center of mass (2,) to the border of the support polygon of points (n, 2).

    Negative outside, and without an area; -inf without points.
    """
    if len(points) == 0:
        return -np.inf
    try:
        equations = ConvexHull(points).equations  # normal . x + offset <= 0 inside
    except (QhullError, ValueError):
        return -float(np.linalg.norm(points - center, axis=1).min())
    return -float((equations[:, :2] @ center + equations[:, 2]).max())
