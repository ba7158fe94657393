"""Domain randomization at every reset, drawn from the reset's seed.

An object and everything on it move together, stay on their support and touch neither new objects nor the robot
(`layout_randomization`). Mass and friction stay within the bundle's `ranges`.
"""

import zlib
from collections.abc import Hashable
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np
import torch

from registry import UsageError
from simrecon_envs.layout_randomization import Group, about, group_things
from simrecon_envs.reset_settling import settle_check
from simrecon_envs.robots import traits_of

_TRIES = 6  # draws of a pose per group before it stays
_TINTS = 4  # variants of a texture, created on demand
_TINTED_PX = 512  # bounds their width
_ARM_M = 0.8  # length of an arm, for the displacement of the hand by joint noise


@dataclass(frozen=True, kw_only=True)
class Randomization:
    """Amounts of randomization; 0 is none. "all" is `everything()`, "start" is `start()`."""

    shift_m: float = 0.0
    """Maximum shift of an object along x and y."""
    turn_rad: float = 0.0
    """Maximum rotation about the vertical axis."""
    joints_rad: float = 0.0
    """Maximum change of each joint of the robot, without fingers and mobile base."""
    mass: float = 0.0
    """Share of the bundle's mass range that is used, on a logarithmic scale."""
    friction: float = 0.0
    """Share of the bundle's friction range that is used, on a logarithmic scale."""
    lights: float = 0.0
    """Maximum relative change of the brightness and color of lights."""
    textures: float = 0.0
    """Maximum relative change of the colors of objects."""
    camera_m: float = 0.0
    """Standard deviation of the position of fixed cameras."""
    camera_rad: float = 0.0
    """Standard deviation of the orientation of fixed cameras."""
    image_noise: float = 0.0
    """Standard deviation of a color value (0 to 255), at every step."""
    depth_noise: float = 0.0
    """Standard deviation of depth at 1 m, in metres, at every step; proportional to the square of depth."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        for item in fields(self):
            value = getattr(self, item.name)
            most = 1.0 if item.name in ("mass", "friction", "lights", "textures") else float("inf")
            if not isinstance(value, int | float) or not 0 <= value <= most:
                raise UsageError(f"randomize: {item.name}={value!r} is not a number between 0 and {most:g}")

    @classmethod
    def everything(cls) -> "Randomization":
        """Return moderate amounts of everything."""
        return cls(shift_m=0.05, turn_rad=0.5, joints_rad=0.05, mass=1.0, friction=1.0, lights=0.4, textures=0.3,
                   camera_m=0.02, camera_rad=0.03, image_noise=4.0, depth_noise=0.003)  # fmt: skip

    @classmethod
    def start(cls) -> "Randomization":
        """Return moderate amounts for the initial poses of objects and robot, and nothing else."""
        return cls(shift_m=0.05, turn_rad=0.5, joints_rad=0.05)

    @classmethod
    def parse(cls, value: "str | dict | Randomization | None") -> "Randomization":
        """Parse an option: None or "none", "start", "all", or a dict of the fields.

        Raises:
            UsageError: The value is invalid; lists the fields.
        """
        if isinstance(value, cls):
            return value
        if value in (None, "none"):
            return cls()
        if value == "all":
            return cls.everything()
        if value == "start":
            return cls.start()
        names = [item.name for item in fields(cls)]
        if not isinstance(value, dict) or set(value) - set(names):
            raise UsageError(
                f'randomize: expected "none", "start", "all" or a dict of {", ".join(names)}, got {value!r}'
            )
        return cls(**value)

    @property
    def any(self) -> bool:
        """Return whether anything is randomized."""
        return any(asdict(self).values())


class Randomizer:
    """Draw and apply a `Randomization` in an environment."""

    def __init__(self, env: Any, config: Randomization) -> None:
        """Find the groups that move together in a `SceneEnv` with its facts and placement."""
        self._env, self.config = env, config
        self._entries = {entry["id"]: entry for entry in env.bundle.scene["objects"]}
        self._groups: list[Group] = []
        self._moved: list[Group] = []
        self._places: dict[int, list[np.ndarray]] = {}
        self.returned: tuple[int, ...] = ()
        """Ids of objects at their captured poses because the drawn poses failed the settle check of this episode."""
        if config.shift_m or config.turn_rad:
            robot = env.robot_points if env.placement is None else env.placement.to_world(env.robot_points)
            # The hand moves by about the arm's length times the change of a joint.
            self._groups = group_things(env.facts, robot, config.joints_rad * _ARM_M)
        self.layer: Any = None
        """The `SplatLayer` of an environment that draws Gaussians: it takes the light and the tints of the scene."""
        self._home: dict[Hashable, Any] = {}  # nominal lights, colors and camera poses
        self._nominal: dict[
            tuple[int, int], tuple[float, np.ndarray, list[float]]
        ] = {}  # by body and environment

    # ---- Poses.

    def poses(self, env_idx: torch.Tensor, rng: Any) -> None:
        """Draw new poses of the groups in the environments `env_idx`, whose objects are at their captured poses."""
        if not self._groups:
            return
        index = env_idx.cpu().numpy()
        draws = np.asarray(rng[index].uniform(-1, 1, size=(len(self._groups), _TRIES, 3)), np.float64)
        draws = draws.reshape(len(index), len(self._groups), _TRIES, 3)
        moves = [self._moves(one) for one in draws]
        for number, group in enumerate(self._groups):
            self._place(group, [move[number] for move in moves])
        self._moved = [
            group for group, move in zip(self._groups, moves[0], strict=True) if (move != np.eye(4)).any()
        ]

    def settle(self) -> None:
        """Run the settle check on the moved groups; return those that fall to their captured poses.

        A group that blocks a captured pose returns, too. One environment on the CPU; all objects sleep afterwards.
        """
        self.returned = ()
        if not self._groups:
            return
        moved = {key for group in self._moved for key in group.members}
        self._env.builder.rest(self._env.builder.movable_ids - moved)
        if moved:
            fell = settle_check(self._env)
            for group in self.fallen_groups(fell):
                self._place(group, [np.eye(4)])
                self.returned += tuple(key for key in group.members if key in moved)
            self._env.builder.rest()

    def fallen_groups(self, fell: set[int]) -> list[Group]:
        """Return the groups of fallen objects, and the groups that block their captured poses."""
        back = [group for group in self._groups if not fell.isdisjoint(group.members)]
        for group in back:  # grows during the loop
            self._places[id(group)] = group.outlines
            back += [
                other
                for other in self._moved
                if all(other is not one for one in back)
                and not group.clears(other, group.outlines, self._places[id(other)])
            ]
        return back

    def _place(self, group: Group, moves: list[np.ndarray]) -> None:
        """Move a group from its captured pose by transforms (4, 4), one per environment."""
        for stack in group.stacks:
            for key, start in stack.start.items():
                poses = np.stack([move @ start for move in moves])
                self._env.builder.place(key, poses, self._env.device)

    def _moves(self, draws: np.ndarray) -> list[np.ndarray]:
        """Return one transform (4, 4) per group from draws (groups, tries, 3) in [-1, 1]."""
        self._places = places = {id(group): group.outlines for group in self._groups}
        moves = [np.eye(4) for _ in self._groups]
        for number, group in enumerate(self._groups):
            for draw in draws[number]:
                shift, turn = draw[:2] * self.config.shift_m, draw[2] * self.config.turn_rad
                move = group.move(about(group.center, shift, turn), places)
                if move is not None:
                    moves[number] = move
                    break
        return moves

    # ---- The robot.

    def joints(self, env_idx: torch.Tensor, rng: Any, qpos: np.ndarray) -> np.ndarray:
        """Draw joint positions (b, d) (rad, m) in the environments `env_idx`, about those at rest (d,)."""
        out = np.repeat(qpos[None], len(env_idx), axis=0)
        if not self.config.joints_rad:
            return out
        base = 3 if traits_of(self._env.robot_uids).mobile else 0  # x, y and heading of a mobile base
        arm = slice(base, max(len(qpos) - 2, base))  # the last two are the fingers
        draws = np.asarray(rng[env_idx.cpu().numpy()].uniform(-1, 1, size=len(qpos)), np.float64)
        out[:, arm] += self.config.joints_rad * draws.reshape(out.shape)[:, arm]
        return out

    # ---- Mass and friction.

    def physics(self, env_idx: torch.Tensor, rng: Any) -> None:
        """Draw masses and frictions in the environments `env_idx`."""
        if not (self.config.mass or self.config.friction):
            return
        for body in (body for body in self._env.builder.bodies if body.dynamic):
            factors = self._factors(body, env_idx, rng)
            for row, number in enumerate(env_idx.tolist()):
                self._set_physics(body, number, *factors[row])
            weight = torch.as_tensor(factors[:, 0], dtype=torch.float32, device=self._env.device)
            self._env.measures.scale_weight(body.root, env_idx, weight)

    def _factors(self, body: Any, env_idx: torch.Tensor, rng: Any) -> np.ndarray:
        """Draw factors of mass and friction (b, 2) of a body, from the ranges of its root object."""
        index = env_idx.cpu().numpy()
        draws = np.asarray(rng[index].uniform(size=2), np.float64).reshape(len(index), 2)
        entry = self._entries[body.root]
        ranges = entry.get("ranges", {})
        out = np.ones((len(index), 2))
        shares = ("mass_kg", self.config.mass), ("friction", self.config.friction)
        for column, (name, share) in enumerate(shares):
            low, high = np.maximum(ranges.get(name, [entry[name]] * 2), 1e-6) / max(entry[name], 1e-6)
            ends = np.log([low, high]) * share
            out[:, column] = np.exp(ends[0] + draws[:, column] * (ends[1] - ends[0]))
        return out

    def _set_physics(self, body: Any, number: int, mass: float, friction: float) -> None:
        component = self._env.builder.objects[body.root].actor._bodies[number]
        key = (body.root, number)
        if key not in self._nominal:
            frictions = [shape.physical_material.static_friction for shape in component.collision_shapes]
            self._nominal[key] = (float(component.mass), np.asarray(component.inertia), frictions)
        nominal_mass, inertia, frictions = self._nominal[key]
        component.mass = nominal_mass * mass
        component.inertia = (inertia * mass).astype(np.float32)
        for shape, value in zip(component.collision_shapes, frictions, strict=True):
            shape.physical_material.static_friction = value * friction
            shape.physical_material.dynamic_friction = value * friction

    def rebuilt(self) -> None:
        """Forget nominal values of the previous bodies; call after the scene was rebuilt."""
        self._nominal = {}
        self._home = {}

    # ---- Appearance.

    def looks(self, env_idx: torch.Tensor, rng: Any) -> None:
        """Draw lights, colors and the poses of the cameras in the environments `env_idx`."""
        env = self._env
        if not env.scene.can_render() or env.scene.parallel_in_single_scene:
            return
        for number in env_idx.tolist():
            one = rng.rngs[number]
            if self.config.lights:
                _draw_lights(env.scene.sub_scenes[number], one, self.config.lights, self._home, number)
                if self.layer is not None:
                    now, nominal = env.scene.sub_scenes[number].ambient_light, self._home["lights", number][0]
                    self.layer.gain = (np.array(now)[:3] / nominal).astype(np.float32) ** np.float32(1 / 2.2)
            if self.config.textures:
                for placed in {id(p.actor): p for p in env.builder.objects.values()}.values():
                    entity = placed.actor._objs[number]
                    if self.layer is not None:
                        variant = int(one.randint(_TINTS))
                        self.layer.tint(entity, _tint(entity, 0, 0, variant, self.config.textures))
                    else:
                        _draw_tint(entity, one, self.config.textures, self._home)
        if (self.config.camera_m or self.config.camera_rad) and not env.gpu_sim_enabled:
            for name, sensor in env._sensors.items():
                if sensor.entity is None:
                    _draw_camera(name, sensor.camera, rng.rngs[0], self.config, self._home)

    def pictures(self, data: dict, rng: Any) -> dict:
        """Add noise to the sensors' images, drawn anew at every step."""
        if not (self.config.image_noise or self.config.depth_noise):
            return data
        for textures in data.values():
            for name, picture in textures.items():
                if name == "rgb" and self.config.image_noise:
                    noise = torch.as_tensor(_noise(rng, picture.shape), device=picture.device)
                    noisy = picture.float() + self.config.image_noise * noise
                    textures[name] = noisy.round().clamp(0, 255).to(picture.dtype)
                elif name == "depth" and self.config.depth_noise:
                    # Integer depth is in millimetres.
                    unit = 1.0 if picture.is_floating_point() else 1e-3
                    noise = torch.as_tensor(_noise(rng, picture.shape), device=picture.device)
                    depth = picture.float() * unit
                    noisy = (depth + self.config.depth_noise * depth**2 * noise).clamp(min=0) / unit
                    noisy = noisy if picture.is_floating_point() else noisy.round().clamp(max=32767)
                    textures[name] = torch.where(picture == 0, picture, noisy.to(picture.dtype))
        return data


def _draw_lights(
    scene: Any, rng: np.random.RandomState, most: float, home: dict[Hashable, Any], number: int
) -> None:
    import sapien

    found = [e.find_component_by_type(sapien.render.RenderDirectionalLightComponent) for e in scene.entities]
    lights = [light for light in found if light is not None]
    if ("lights", number) not in home:
        home["lights", number] = [
            np.array(scene.ambient_light)[:3],
            *(np.array(light.color) for light in lights),
        ]
    for place, start in enumerate(home["lights", number]):
        bright = 1 + most * rng.uniform(-1, 1)
        tint = 1 + 0.3 * most * rng.uniform(-1, 1, size=3)
        color = np.clip(start * bright * tint, 0, 4).astype(np.float32)
        if place == 0:
            scene.ambient_light = color
        else:
            lights[place - 1].color = color


def _draw_tint(entity: Any, rng: np.random.RandomState, most: float, home: dict[Hashable, Any]) -> None:
    """Give an entity one of `_TINTS` tints; tints textures themselves, because they hide the material's color."""
    import sapien

    variant = int(rng.randint(_TINTS))
    body = entity.find_component_by_type(sapien.render.RenderBodyComponent)
    for place, shape in enumerate(body.render_shapes if body is not None else ()):
        for part_number, part in enumerate(shape.parts):
            key = ("tint", entity.name, place, part_number, entity.per_scene_id)
            if key not in home:
                home[key] = (np.array(part.material.base_color), part.material.base_color_texture)
            color, texture = home[key]
            tint = _tint(entity, place, part_number, variant, most)
            if texture is None:
                part.material.base_color = [*np.clip(color[:3] * tint, 0, 1), color[3]]
                continue
            tinted = (*key, variant)
            if tinted not in home:
                home[tinted] = _tinted(texture, tint)
            part.material.base_color_texture = home[tinted]


def _tint(entity: Any, place: int, part_number: int, variant: int, most: float) -> np.ndarray:
    """Return a variant's factor (3,) of the colors of a part of an entity."""
    seed = zlib.crc32(f"{entity.name} {place} {part_number} {variant}".encode())
    return 1 + most * np.random.RandomState(seed).uniform(-1, 1, size=3)


def _tinted(texture: Any, tint: np.ndarray) -> Any:
    """Return an 8-bit texture times a tint (3,), subsampled towards a width of 512 pixels."""
    import sapien

    pixels = texture.download()
    step = max(pixels.shape[1] // _TINTED_PX, 1)
    pixels = pixels[::step, ::step].astype(np.float32)
    pixels[..., :3] *= tint
    return sapien.render.RenderTexture2D(pixels.clip(0, 255).astype(np.uint8), texture.format, srgb=True)


def _draw_camera(
    name: str, camera: Any, rng: np.random.RandomState, config: Randomization, home: dict[Hashable, Any]
) -> None:
    import sapien

    if ("camera", name) not in home:
        home["camera", name] = camera.get_local_pose().sp
    start = home["camera", name]
    angles = config.camera_rad * rng.normal(size=3)
    turn = np.linalg.norm(angles)
    axis = angles / turn if turn > 0 else np.array([1.0, 0, 0])
    quat = [np.cos(turn / 2), *(np.sin(turn / 2) * axis)]
    shift: Any = config.camera_m * rng.normal(size=3)
    camera.set_local_pose(start * sapien.Pose(shift, quat))


def _noise(rng: Any, shape: tuple[int, ...]) -> np.ndarray:
    return np.stack([one.standard_normal(size=shape[1:]).astype(np.float32) for one in rng.rngs])
