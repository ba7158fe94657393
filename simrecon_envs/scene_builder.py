"""Build the actors of a scene bundle in a ManiSkill scene (once per reconfigure) and pose them (once per reset).

| in the bundle                            | actor                                                    |
|------------------------------------------|----------------------------------------------------------|
| floor, wall, ceiling                     | static: convex slabs, or a box behind its plane          |
| object, `dynamic: false`                 | static                                                   |
| object attached to a static one          | static                                                   |
| object attached to a dynamic one         | welded: its shapes, mass and inertia join the parent's actor |
| other objects                            | dynamic: the bundle's mass, inertia, friction, restitution |

Welded objects are one rigid body: there is no compliant joint, on the CPU and on the GPU.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import sapien
import torch
from mani_skill.utils.building.actor_builder import ActorBuilder
from mani_skill.utils.structs.actor import Actor
from mani_skill.utils.structs.pose import Pose
from sapien import physx

from registry import BundleObject, SceneBundle
from registry.geometry import (
    WORLD_FROM_GLTF,
    invert_rigid,
    matrix_from_quat,
    quat_from_matrix,
    transform_points,
)
from registry.rigid_groups import moving_ids, welded_to

# Shapes and masses are those of the bundle's physics report card.
from registry.simulation import (
    BASE_FRICTION,
    BASE_RESTITUTION,
    BodySpec,
    base_spec,
    convex_shape,
    set_inertial,
)
from simrecon_envs.occupancy import ConvexSolid, base_parts, read_obj_vertices

_GROUND_BELOW_FLOOR_M = 0.002  # height of the ground plane below the floor
_GROUND_MARGIN_M = 25.0  # of the visible ground plate around the scene
# Fetch's wheels and base do not collide with floor and ground (bits as in mani_skill.agents.robots.fetch).
_WHEEL_BIT, _BASE_BIT = 30, 31


@dataclass(frozen=True)
class Body:
    """Description of an actor: a root object and the objects welded to it."""

    root: int
    name: str
    specs: tuple[BodySpec, ...]  # root first
    visuals: tuple[tuple[str, np.ndarray], ...]  # (file, root_from_object (4, 4))
    world_from_root: np.ndarray  # float64 (4, 4)
    dynamic: bool


@dataclass(frozen=True)
class PlacedObject:
    """An object of the bundle and its actor in the simulator."""

    id: int
    label: str
    actor: Actor
    actor_from_object: np.ndarray  # float64 (4, 4); the identity unless it is welded to another object
    dynamic: bool


class SceneBuilder:
    """Build the actors of a bundle (`build`) and pose them (`initialize`)."""

    def __init__(self, bundle: SceneBundle, extent: tuple[np.ndarray, np.ndarray]) -> None:
        """Read the bodies; the simulator is not used yet. `extent` is (lower (3,), upper (3,)) of the scene."""
        self.bundle = bundle
        self.extent = extent
        self.bodies = bodies_of(bundle)
        self.movable_ids = {body.root for body in self.bodies if body.dynamic}
        self.objects: dict[int, PlacedObject] = {}
        self._base_actors: dict[int, list[Actor]] = {}
        self.backdrop: Actor | None = None
        """Actor behind everything, drawn and never in contact; None: the bundle has none, or nothing is rendered."""

    def carrying_actors(self, key: int) -> list[Actor]:
        """Return the actors of an object or base entity; a floor includes the ground plane."""
        return self._base_actors[key] if key in self._base_actors else [self.objects[key].actor]

    @property
    def movable_actors(self) -> list[PlacedObject]:
        """Return the dynamic actors, in the order of the bundle."""
        return [self.objects[body.root] for body in self.bodies if body.dynamic]

    def build(self, scene: Any, pedestal: tuple[np.ndarray, float, float] | None = None) -> None:
        """Create all actors in a ManiSkill scene.

        Args:
            scene: The `ManiSkillScene`.
            pedestal: (position (3,) of its top, height, radius) of the robot's pedestal (m), or None.
        """
        self.objects = {}
        self._build_base(scene)
        self._build_backdrop(scene)
        for body in self.bodies:
            actor = _BodyBuilder(scene, body).build(name=body.name)
            for spec in body.specs:
                root_from_object = invert_rigid(body.world_from_root) @ spec.world_from_object
                label = next(o.label for o in self.bundle.objects if o.id == spec.id)
                self.objects[spec.id] = PlacedObject(spec.id, label, actor, root_from_object, body.dynamic)
        if pedestal is not None:
            _build_pedestal(scene, *pedestal)

    def initialize(
        self, env_idx: torch.Tensor, device: torch.device, noise: tuple[float, float], rng: Any
    ) -> None:
        """Set the dynamic actors of the environments `env_idx` (b,) to their poses in the bundle.

        Args:
            env_idx: Indices of the parallel environments that are reset.
            device: Device of the simulator's tensors.
            noise: Standard deviations of a random horizontal shift (m) and a rotation about +z (rad).
            rng: ManiSkill's batched generator; `rng[env_idx].normal(size=...)`.
        """
        for body in self.bodies:
            if not body.dynamic:
                continue
            count = len(env_idx)
            position = np.repeat(body.world_from_root[None, :3, 3], count, axis=0)
            rotation = np.repeat(body.world_from_root[None, :3, :3], count, axis=0)
            if noise[0] > 0 or noise[1] > 0:
                draws = np.asarray(rng[env_idx.cpu().numpy()].normal(size=3)).reshape(count, 3)
                position[:, :2] += noise[0] * np.clip(draws[:, :2], -2, 2)
                half = 0.5 * noise[1] * np.clip(draws[:, 2], -2, 2)
                zero = np.zeros(count)
                turn = matrix_from_quat(np.stack([np.cos(half), zero, zero, np.sin(half)], axis=1))
                rotation = turn @ rotation
            self._set_pose(body.root, position, quat_from_matrix(rotation), device)

    def rest(self, keys: Iterable[int] | None = None) -> None:
        """Put all movable objects, or those in `keys`, to sleep until a contact or move wakes them; CPU only.

        Their poses are settled, by the assembly or by the settle check. Awake objects could still tip: PhysX adds up
        forces in another order when any other object of the scene moves.
        """
        for key in self.movable_ids if keys is None else keys:
            self.objects[key].actor._bodies[0].put_to_sleep()

    def shift(self, key: int, env_idx: torch.Tensor, moved: np.ndarray, device: torch.device) -> None:
        """Move an object of the environments `env_idx` (b,) by (b, 3) from its pose in the bundle."""
        body = next(body for body in self.bodies if body.root == key)
        poses = np.repeat(body.world_from_root[None], len(env_idx), axis=0)
        poses[:, :3, 3] += moved
        self.place(key, poses, device)

    def place(self, key: int, poses: np.ndarray, device: torch.device) -> None:
        """Set the poses (b, 4, 4) of an object in the environments that are being reset."""
        self._set_pose(key, poses[:, :3, 3], quat_from_matrix(poses[:, :3, :3]), device)

    def _set_pose(self, key: int, position: np.ndarray, quat: np.ndarray, device: torch.device) -> None:
        p, q = (torch.as_tensor(x, dtype=torch.float32, device=device) for x in (position, quat))
        self.objects[key].actor.set_pose(Pose.create_from_pq(p, q))

    def _build_base(self, scene: Any) -> None:
        """Build floors, walls, ceilings and an infinite ground plane below."""
        ground = scene.create_actor_builder()
        material = physx.PhysxMaterial(BASE_FRICTION, BASE_FRICTION, BASE_RESTITUTION)
        # It stops objects that leave the reconstructed floor.
        plane = sapien.Pose([0, 0, -_GROUND_BELOW_FLOOR_M], [0.7071068, 0, -0.7071068, 0])
        ground.add_plane_collision(plane, material)
        if scene.can_render():
            # The visible plate is lower, because a reconstructed floor may lie a little below z = 0.
            lower, upper = self.extent
            half = [*((upper - lower)[:2] / 2 + _GROUND_MARGIN_M), 0.01]
            center = [*((upper + lower)[:2] / 2), -0.06]
            gray = _matte([0.55, 0.55, 0.55, 1.0])
            ground.add_box_visual(sapien.Pose(center), half_size=half, material=gray)
        ground.initial_pose = sapien.Pose()
        drivable = [ground.build_static(name="ground")]
        for base in self.bundle.base:
            spec = base_spec(base.id, base.label, base_parts(self.bundle, base))
            visual = ((str(self.bundle.resolve(base.mesh)), np.eye(4)),)
            body = Body(base.id, spec.name, (spec,), visual, np.eye(4), False)
            actor = _BodyBuilder(scene, body).build(name=spec.name)
            self._base_actors[base.id] = [actor, drivable[0]] if base.label == "floor" else [actor]
            if base.label == "floor":
                drivable.append(actor)
        for actor in drivable:
            for bit in (_WHEEL_BIT, _BASE_BIT):
                actor.set_collision_group_bit(group=2, bit_idx=bit, bit=1)

    def _build_backdrop(self, scene: Any) -> None:
        """Build the bundle's backdrop without a collision shape; it shows its texture as filmed, without light."""
        if self.bundle.backdrop is None or not scene.can_render():
            return
        builder = scene.create_actor_builder()
        builder.add_visual_from_file(
            str(self.bundle.resolve(self.bundle.backdrop)), pose=_pose(WORLD_FROM_GLTF)
        )
        builder.initial_pose = sapien.Pose()
        actor = builder.build_static(name="backdrop")
        for entity in actor._objs:
            show_unlit(entity)
        self.backdrop = actor


class _BodyBuilder(ActorBuilder):
    """Actor builder for the convex parts of a `Body`.

    It raises an error if PhysX cannot cook a part; ManiSkill's builder silently drops the part.
    """

    def __init__(self, scene: Any, body: Body) -> None:
        super().__init__()
        self.set_scene(scene)
        self._body = body
        self.set_physx_body_type("dynamic" if body.dynamic else "static")
        self.initial_pose = _pose(body.world_from_root)
        if scene.can_render():
            for file, root_from_object in body.visuals:
                self.add_visual_from_file(file, pose=_pose(root_from_object @ WORLD_FROM_GLTF))

    def build_physx_component(self, link_parent: Any = None) -> physx.PhysxBaseComponent:
        """Create the rigid body with its collision shapes."""
        body = self._body
        kind: Any = physx.PhysxRigidDynamicComponent if body.dynamic else physx.PhysxRigidStaticComponent
        component = kind()
        for spec in body.specs:
            root_from_object = invert_rigid(body.world_from_root) @ spec.world_from_object
            material = physx.PhysxMaterial(spec.friction, spec.friction, spec.restitution)
            for part in spec.parts:
                shape = convex_shape(physx, transform_points(root_from_object, part), material, spec)
                shape.set_collision_groups(self.collision_groups)
                component.attach(shape)
        if body.dynamic:
            set_inertial(sapien, component, merged_mass(body))
            component.set_linear_damping(0.0)
            component.set_angular_damping(0.0)
        component.name = self.name
        return component


def bodies_of(bundle: SceneBundle) -> list[Body]:
    """Group the objects of a bundle into actors: objects attached to a dynamic object join its actor."""
    items = {item.id: item for item in bundle.objects}
    moving, welds = moving_ids(bundle), welded_to(bundle)

    def root_of(key: int) -> int:
        return root_of(welds[key]) if key in welds else key

    members: dict[int, list[int]] = {}
    for key in items:
        members.setdefault(root_of(key), []).append(key)
    bodies = []
    for root in items:
        if root not in members:
            continue
        keys = [root, *(key for key in members[root] if key != root)]
        world_from_root = items[root].world_from_object
        specs = tuple(_spec(bundle, items[key]) for key in keys)
        root_from_world = invert_rigid(world_from_root)
        visuals = tuple(
            (str(bundle.resolve(items[key].visual)), root_from_world @ items[key].world_from_object)
            for key in keys
        )
        name = f"{items[root].label}_{root}"
        bodies.append(Body(root, name, specs, visuals, np.asarray(world_from_root), root in moving))
    return bodies


def merged_mass(body: Body) -> BodySpec:
    """Combine mass, centre of mass and inertia of all specs (parallel axis theorem) into one spec in root space."""
    if len(body.specs) == 1:
        return replace(body.specs[0], world_from_object=np.eye(4))
    total = sum(spec.mass_kg for spec in body.specs)
    placed = [(spec, invert_rigid(body.world_from_root) @ spec.world_from_object) for spec in body.specs]
    centers = [transform_points(pose, spec.center_of_mass[None])[0] for spec, pose in placed]
    center = sum(spec.mass_kg * c for (spec, _), c in zip(placed, centers)) / total
    inertia = np.zeros((3, 3))
    for (spec, pose), c in zip(placed, centers):
        own = spec.inertia if spec.inertia is not None else _box_inertia(spec)
        arm = c - center
        inertia += pose[:3, :3] @ own @ pose[:3, :3].T
        inertia += spec.mass_kg * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    return replace(
        body.specs[0], mass_kg=total, center_of_mass=center, inertia=inertia, world_from_object=np.eye(4)
    )


def scene_extent(solids: list[ConvexSolid]) -> tuple[np.ndarray, np.ndarray]:
    """Return the bounding box (lower (3,), upper (3,)) of all solids."""
    if not solids:
        return np.array([-1.0, -1.0, 0.0]), np.array([1.0, 1.0, 1.0])
    return np.min([s.lower for s in solids], axis=0), np.max([s.upper for s in solids], axis=0)


def _spec(bundle: SceneBundle, item: BundleObject) -> BodySpec:
    return BodySpec(
        id=item.id,
        name=f"{item.label}_{item.id}",
        parts=tuple(read_obj_vertices(bundle.resolve(path)) for path in item.collision),
        mass_kg=item.mass_kg,
        center_of_mass=item.center_of_mass,
        inertia=item.inertia,
        friction=item.friction,
        restitution=item.restitution,
        world_from_object=item.world_from_object,
        dynamic=item.dynamic,
    )


def _box_inertia(spec: BodySpec) -> np.ndarray:
    size = np.ptp(np.concatenate(spec.parts), axis=0)
    return spec.mass_kg / 12 * np.diag(size @ size - size**2)


def _build_pedestal(scene: Any, top: np.ndarray, height: float, radius: float) -> None:
    builder = scene.create_actor_builder()
    half = [radius, radius, height / 2]
    builder.add_box_collision(half_size=half)
    if scene.can_render():
        builder.add_box_visual(half_size=half, material=_matte([0.22, 0.23, 0.25, 1.0]))
    builder.initial_pose = sapien.Pose([top[0], top[1], top[2] - height / 2])
    builder.build_static(name="pedestal")


def show_unlit(entity: sapien.Entity) -> None:
    """Let an actor show its texture unchanged: textures from a video have the room's light in them."""
    body: Any = entity.find_component_by_type(sapien.render.RenderBodyComponent)
    for shape in body.render_shapes if body is not None else ():
        for part in shape.parts:
            material = part.material
            if material.base_color_texture is not None:
                material.emission_texture, material.base_color_texture = material.base_color_texture, None
            else:
                material.emission = material.base_color
            material.base_color = [0, 0, 0, 1]
            material.specular = 0.0


def _matte(color: list[float]) -> "sapien.render.RenderMaterial":
    return sapien.render.RenderMaterial(base_color=color, roughness=1.0, specular=0.0, metallic=0.0)


def _pose(matrix: np.ndarray) -> sapien.Pose:
    p: Any = matrix[:3, 3].astype(np.float32)
    q: Any = quat_from_matrix(matrix[:3, :3]).astype(np.float32)
    return sapien.Pose(p, q)
