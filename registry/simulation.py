# pyright: strict, reportUnknownMemberType=false, reportUnknownArgumentType=false, reportUnknownVariableType=false
"""Build and step a PhysX scene of rigid bodies in SAPIEN, without rendering and without ManiSkill.

Assembly, the report card (`registry.report_card`) and tests share it, so that they measure the same. SAPIEN is imported
inside functions: importing the registry stays fast. No Vulkan driver is necessary.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from registry.errors import BundleError, EnvironmentMissing, SimReconError
from registry.geometry import matrix_from_quat, quat_from_matrix, rigid
from registry.primitives import Primitive, primitive_of

TIMESTEP_S = 1 / 240
BASE_FRICTION, BASE_RESTITUTION = 0.5, 0.0  # of floors and walls; PhysX averages them with the object's
_WELD = 1e6, 1e4, 1e10, "acceleration"  # stiffness, damping, force limit of the drive of a fixed child
_MAX_PART_VERTICES = 255  # of a convex mesh in PhysX
_MIN_PART_THICKNESS_M = 1e-3  # flatter parts cannot be cooked by PhysX and are thickened to this


@dataclass(frozen=True)
class BodySpec:
    """A rigid body. Lengths in metres, masses in kilograms."""

    id: int
    name: str
    parts: tuple[np.ndarray, ...]  # convex parts, each (v, 3) vertices in object space
    mass_kg: float
    center_of_mass: np.ndarray  # (3,) object space
    inertia: np.ndarray | None  # (3, 3) kg m^2 about the centre of mass, object axes; None: from the shapes
    friction: float
    restitution: float
    world_from_object: np.ndarray  # (4, 4) rigid
    dynamic: bool
    fixed_to: int | None = None  # id of its parent, for a dynamic body fixed to a dynamic one
    base: bool = False  # floor, wall or ceiling: static and not measured


@dataclass(frozen=True)
class Contact:
    """A contact point between two bodies; a negative separation is penetration."""

    first: int
    second: int
    separation_m: float
    normal: np.ndarray  # (3,) world, from `second` towards `first`
    position: np.ndarray  # (3,) world
    impulse: np.ndarray  # (3,) N s on `first`


class Physics:
    """A PhysX CPU scene of bodies that can be moved, frozen and stepped. Base bodies are static."""

    def __init__(self, timestep_s: float, sleep_threshold: float) -> None:
        """Create an empty scene; with `sleep_threshold` 0 no body falls asleep."""
        sapien, physx = _sapien()
        self.timestep_s = timestep_s
        self._sleep_threshold = sleep_threshold
        previous = physx.get_scene_config()
        config = physx.PhysxSceneConfig()
        # Results must not depend on other bodies in the scene, nor on the configuration left by other code.
        config.enable_enhanced_determinism = True
        physx.set_scene_config(config)
        try:
            self.scene = sapien.Scene([physx.PhysxCpuSystem()])
        finally:
            physx.set_scene_config(previous)
        self.scene.set_timestep(timestep_s)
        self.specs: dict[int, BodySpec] = {}
        self._entities: dict[int, Any] = {}
        self._bodies: dict[int, Any] = {}

    def add(self, spec: BodySpec, *, kinematic: bool | None = None) -> None:
        """Add a body at its pose; `kinematic` overrides `not spec.dynamic`."""
        sapien, physx = _sapien()
        if spec.id in self._bodies:
            raise SimReconError(f"physics: two bodies have id {spec.id} ('{spec.name}')")
        previous = physx.get_body_config()
        config = physx.PhysxBodyConfig()
        config.sleep_threshold = self._sleep_threshold
        config.solver_position_iterations = 15  # as in ManiSkill's default scene
        config.solver_velocity_iterations = 1
        physx.set_body_config(config)
        try:
            body = physx.PhysxRigidStaticComponent() if spec.base else physx.PhysxRigidDynamicComponent()
        finally:
            physx.set_body_config(previous)
        material = physx.PhysxMaterial(spec.friction, spec.friction, spec.restitution)
        for part in spec.parts:
            body.attach(convex_shape(physx, part, material, spec))
        if not spec.base:
            set_inertial(sapien, body, spec)
            # SAPIEN's default angular damping is 0.05; the contract requires none.
            body.set_linear_damping(0.0)
            body.set_angular_damping(0.0)
            body.kinematic = (not spec.dynamic) if kinematic is None else kinematic
        entity = sapien.Entity()
        entity.name = str(spec.id)  # `contacts` reads the id from it
        entity.add_component(body)
        entity.pose = _pose(sapien, spec.world_from_object)
        self.scene.add_entity(entity)
        self.specs[spec.id], self._entities[spec.id], self._bodies[spec.id] = spec, entity, body

    def remove(self, body_id: int) -> None:
        """Remove a body from the scene."""
        entity = self._entities.pop(body_id)
        self._bodies.pop(body_id)
        self.specs.pop(body_id)
        self.scene.remove_entity(entity)

    def fix(self, child: int, parent: int) -> None:
        """Fix a dynamic child to its parent in their current relative pose, by a drive."""
        sapien, physx = _sapien()
        drive = physx.PhysxDriveComponent(self._bodies[child])
        drive.set_parent(self._bodies[parent])
        drive.set_pose_in_parent(self._entities[parent].pose.inv() * self._entities[child].pose)
        drive.set_pose_in_child(sapien.Pose())
        drive.set_limit_x(0, 0, 0, 0)
        drive.set_limit_y(0, 0, 0, 0)
        drive.set_limit_z(0, 0, 0, 0)
        # Zero angular limits are unstable: the child rotates about the joint within seconds. A stiff drive holds.
        drive.set_drive_property_slerp(*_WELD)
        self._entities[child].add_component(drive)

    def pose(self, body_id: int) -> np.ndarray:
        """Return `world_from_object` (4, 4) of a body."""
        pose = self._entities[body_id].pose
        return rigid(matrix_from_quat(np.asarray(pose.q)), np.asarray(pose.p, np.float64))

    def set_pose(self, body_id: int, world_from_object: np.ndarray) -> None:
        """Set the pose of a body and its velocities to 0."""
        sapien, _ = _sapien()
        self._entities[body_id].pose = _pose(sapien, world_from_object)
        self.stop(body_id)

    def stop(self, body_id: int) -> None:
        """Set the velocities of a body to 0."""
        body = self._bodies[body_id]
        if not self.specs[body_id].base and not body.kinematic:
            body.set_linear_velocity(np.zeros(3))
            body.set_angular_velocity(np.zeros(3))

    def speed(self, body_id: int) -> tuple[float, float]:
        """Return the linear (m/s) and angular (rad/s) speed of a body."""
        body = self._bodies[body_id]
        linear = float(np.linalg.norm(body.get_linear_velocity()))
        return linear, float(np.linalg.norm(body.get_angular_velocity()))

    def energy_of_motion(self, body_id: int, before: np.ndarray, seconds: float) -> float:
        """Return the kinetic energy (J) of an object's mean motion since an earlier pose (4, 4), `seconds` ago.

        Instantaneous velocities cannot be used: at rest the solver leaves a jitter of centimetres per second in them,
        without motion.
        """
        body, now = self._bodies[body_id], self.pose(body_id)
        center = np.append(np.asarray(body.cmass_local_pose.p, np.float64), 1.0)
        velocity = ((now - before) @ center)[:3] / seconds
        quat = quat_from_matrix(before[:3, :3].T @ now[:3, :3])
        sine = float(np.linalg.norm(quat[1:]))
        turned = 2 * np.arctan2(sine, abs(quat[0])) * quat[1:] / max(sine, 1e-12)
        turning = matrix_from_quat(np.asarray(body.cmass_local_pose.q)).T @ turned / seconds
        return float(0.5 * body.mass * velocity @ velocity + 0.5 * turning**2 @ np.asarray(body.inertia))

    def set_kinematic(self, body_id: int, kinematic: bool) -> None:
        """Freeze an object (kinematic) or release it (dynamic), and stop it."""
        body = self._bodies[body_id]
        if body.kinematic != kinematic:
            body.kinematic = kinematic
        self.stop(body_id)

    def set_damping(self, body_id: int, linear: float, angular: float) -> None:
        """Set the damping rates (1/s) of an object; measurements use 0."""
        self._bodies[body_id].set_linear_damping(linear)
        self._bodies[body_id].set_angular_damping(angular)

    def set_gravity(self, body_id: int, on: bool) -> None:
        """Enable or disable gravity for an object."""
        self._bodies[body_id].set_disable_gravity(not on)

    def step(self, count: int = 1) -> None:
        """Advance by `count` time steps."""
        for _ in range(count):
            self.scene.step()

    def contacts(self, max_separation_m: float = 0.0) -> list[Contact]:
        """Return the contact points of the last step with at most this separation.

        PhysX finds contacts before it moves the bodies: they belong to the poses before the last step.
        """
        out: list[Contact] = []
        for contact in self.scene.get_contacts():
            first, second = (int(body.entity.name) for body in contact.bodies)
            for point in contact.points:
                if point.separation <= max_separation_m:
                    vectors = point.normal, point.position, point.impulse
                    arrays = (np.asarray(vector, np.float64) for vector in vectors)
                    out.append(Contact(first, second, float(point.separation), *arrays))
        return out


def build_physics(
    specs: Iterable[BodySpec], timestep_s: float = TIMESTEP_S, *, sleep_threshold: float = 0.0
) -> Physics:
    """Build a scene of all bodies at their poses; a fixed body may precede its parent."""
    specs = list(specs)
    physics = Physics(timestep_s, sleep_threshold)
    for spec in specs:
        physics.add(spec)
    for spec in specs:
        if spec.fixed_to is not None and spec.dynamic:
            if spec.fixed_to not in physics.specs:
                raise SimReconError(
                    f"physics: body {spec.id} is fixed to {spec.fixed_to}, which does not exist"
                )
            physics.fix(spec.id, spec.fixed_to)
    return physics


def pose_change(start: np.ndarray, end: np.ndarray) -> tuple[float, float]:
    """Return the translation (m) and the rotation angle (degrees) between two poses (4, 4)."""
    moved = float(np.linalg.norm(end[:3, 3] - start[:3, 3]))
    # atan2 of the quaternion is accurate for small angles; arccos of the trace is not.
    quat = quat_from_matrix(start[:3, :3].T @ end[:3, :3])
    return moved, float(np.degrees(2 * np.arctan2(np.linalg.norm(quat[1:]), abs(quat[0]))))


def specs_from_bundle(bundle: Any) -> list[BodySpec]:
    """Read the bodies of a scene bundle; uses `bundle.scene` (CONTRACT section 2) and `bundle.resolve(path)`."""
    scene = bundle.scene
    where = f"bundle '{scene.get('id', '?')}'"
    fixed_to = {e["child"]: e["parent"] for e in scene["graph"]["edges"] if e["relation"] == "attached_to"}
    specs: list[BodySpec] = []
    for base in scene["base"]:
        if not base.get("collision"):
            raise BundleError(
                f"{where}: base {base['id']} ({base['label']}) has no collision slab to stand on; "
                "run `simrecon reconstruct` again to write one"
            )
        parts = [read_obj_points(bundle.resolve(path)) for path in base["collision"]]
        specs.append(base_spec(base["id"], base["label"], parts))
    for item in scene["objects"]:
        inertia = item.get("inertia")
        specs.append(
            BodySpec(
                id=item["id"],
                name=f"{item['label']}_{item['id']}",
                parts=tuple(read_obj_points(bundle.resolve(path)) for path in item["collision"]),
                mass_kg=float(item["mass_kg"]),
                center_of_mass=np.asarray(item["center_of_mass"], np.float64),
                inertia=None if inertia is None else np.asarray(inertia, np.float64),
                friction=float(item["friction"]),
                restitution=float(item["restitution"]),
                world_from_object=np.asarray(item["world_from_object"], np.float64),
                dynamic=bool(item["dynamic"]),
                fixed_to=fixed_to.get(item["id"]),
            )
        )
    return specs


def base_spec(key: int, label: str, parts: Iterable[np.ndarray]) -> BodySpec:
    """Return the static body of a floor, wall or ceiling from convex parts (v, 3) in world space."""
    return BodySpec(
        key, f"{label}_{key}", tuple(parts), 0.0, np.zeros(3), None, BASE_FRICTION, BASE_RESTITUTION, np.eye(4), False,
        base=True,
    )  # fmt: skip


def read_obj_points(path: Path) -> np.ndarray:
    """Read the vertices (v, 3) of a Wavefront .obj file, float64.

    Raises:
        BundleError: It has fewer than four vertices, or a vertex is not finite.
    """
    with path.open(encoding="utf-8") as file:
        points = [[float(x) for x in line.split()[1:4]] for line in file if line.startswith("v ")]
    out = np.asarray(points, np.float64)
    if out.ndim != 2 or out.shape[1:] != (3,) or len(out) < 4 or not np.isfinite(out).all():
        raise BundleError(f"{path}: not a convex part (needs at least 4 finite vertices)")
    return out


def _sapien() -> tuple[Any, Any]:
    """Import SAPIEN on first use."""
    try:
        import sapien
        from sapien import physx
    except ImportError as error:
        raise EnvironmentMissing(
            f"physics needs SAPIEN, which cannot be imported ({error}); run `pip install sapien`, "
            "then `simrecon doctor`"
        ) from error
    return sapien, physx


def _pose(sapien: Any, world_from_object: np.ndarray) -> Any:
    m = np.asarray(world_from_object, np.float64)
    return sapien.Pose(m[:3, 3].astype(np.float32), quat_from_matrix(m[:3, :3]).astype(np.float32))


def convex_shape(physx: Any, part: np.ndarray, material: Any, spec: BodySpec) -> Any:
    """Return the collision shape of a convex part (v, 3): an exact primitive that cannot roll, or its convex hull.

    Flat parts are thickened. Floors and walls are always hulls.

    Raises:
        SimReconError: PhysX cannot cook the hull.
    """
    primitive = None if spec.base else standing_primitive(part)
    if primitive is not None:
        return _primitive_shape(physx, primitive, material)
    points = cookable_points(part)
    try:
        return physx.PhysxCollisionShapeConvexMesh(
            vertices=points.astype(np.float32), scale=np.ones(3, np.float32), material=material
        )
    except RuntimeError as error:
        raise SimReconError(
            f"physics: PhysX cannot use a convex part of '{spec.name}' (id {spec.id}, {len(points)} points, "
            f"extents {np.round(np.ptp(points, axis=0), 4).tolist()} m): {error}"
        ) from error


def standing_primitive(part: np.ndarray) -> Primitive | None:
    """Return the primitive that replaces a convex part (v, 3) in physics and exports, or None to use its hull."""
    primitive = primitive_of(part)
    if primitive is None or 2 * min(primitive.size) < _MIN_PART_THICKNESS_M or not primitive.stands:
        return None
    return primitive


def _primitive_shape(physx: Any, primitive: Primitive, material: Any) -> Any:
    sapien, _ = _sapien()
    pose = np.array(primitive.pose)
    if primitive.shape == "box":
        shape = physx.PhysxCollisionShapeBox(np.asarray(primitive.size, np.float32), material)
    else:
        shape = physx.PhysxCollisionShapeCylinder(*primitive.size, material)
        pose[:3, :3] = np.stack([pose[:3, 2], pose[:3, 1], -pose[:3, 0]], axis=1)  # SAPIEN: axis along x
    shape.set_local_pose(_pose(sapien, pose))
    return shape


def cookable_points(part: np.ndarray) -> np.ndarray:
    """Return the vertices (v, 3) of a convex part to cook: thickened to at least 1 mm, reduced to at most 255."""
    points = np.asarray(part, np.float64)
    center = points.mean(0)
    _, _, axes = np.linalg.svd(points - center, full_matrices=False)
    thin = axes[-1]
    along = (points - center) @ thin
    if np.ptp(along) < _MIN_PART_THICKNESS_M:
        flat = points - along[:, None] * thin
        half = 0.5 * _MIN_PART_THICKNESS_M * thin
        points = np.concatenate([flat - half, flat + half])
    if len(points) > _MAX_PART_VERTICES:
        points = _most_extreme(points, _MAX_PART_VERTICES)
    return points


def _most_extreme(points: np.ndarray, count: int) -> np.ndarray:
    """Keep the support points of directions on a Fibonacci sphere; the hull hardly changes."""
    i = np.arange(count * 4) + 0.5
    polar, turn = np.arccos(1 - 2 * i / len(i)), np.pi * (1 + 5**0.5) * i
    directions = np.stack([np.cos(turn) * np.sin(polar), np.sin(turn) * np.sin(polar), np.cos(polar)])
    keep = np.unique(np.argmax(points @ directions, axis=0))
    return points[keep[:count]]


def set_inertial(sapien: Any, body: Any, spec: BodySpec) -> None:
    """Set mass, centre of mass and principal inertia of a dynamic PhysX body with shapes.

    Raises:
        SimReconError: The mass is not positive.
    """
    if not spec.mass_kg > 0:
        raise SimReconError(
            f"physics: '{spec.name}' (id {spec.id}) has mass {spec.mass_kg} kg, expected more than 0"
        )
    if spec.inertia is None:
        scale = spec.mass_kg / float(body.mass)
        inertia = np.asarray(body.inertia, np.float64) * scale
        pose = body.cmass_local_pose
        pose = sapien.Pose(np.asarray(spec.center_of_mass, np.float32), pose.q)
    else:
        inertia, axes = np.linalg.eigh(0.5 * (spec.inertia + spec.inertia.T))
        if np.linalg.det(axes) < 0:
            axes[:, 0] *= -1
        pose = _pose(sapien, rigid(axes, spec.center_of_mass))
    # PhysX diverges on degenerate tensors of noisy meshes: bound the ratio of the moments, as of a thin rod.
    inertia = np.maximum(inertia, max(1e-3 * float(np.max(inertia)), 1e-9))
    body.mass = spec.mass_kg
    body.cmass_local_pose = pose
    body.inertia = inertia.astype(np.float32)
