"""Domain randomization: what may differ from one reset to the next, all of it drawn from the reset's seed.

Poses stay within the support: a thing and what stands on it move together, stay on the level they stand on, and
touch nothing that they did not touch before, nor the robot (`layout_randomization`). Mass and friction stay within the
bundle's `ranges`.
"""

import zlib
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np
import torch

from registry import UsageError
from simrecon_envs.layout_randomization import Group, about, group_things
from simrecon_envs.reset_settling import rehearse
from simrecon_envs.robots import traits_of

_TRIES = 6
_TINTS = 4  # of each texture, made when they are first drawn
_TINTED_PX = 512
_ARM_M = 0.8


@dataclass(frozen=True, kw_only=True)
class Randomization:
    """How much differs. 0 is nothing; `all` is `Randomization.everything()`, `start` is `Randomization.start()`."""

    shift_m: float = 0.0
    """Greatest horizontal shift of a thing along x and y."""
    turn_rad: float = 0.0
    """Greatest turn about the vertical."""
    joints_rad: float = 0.0
    """Greatest change of each of the robot's joints, fingers and driving base left out."""
    mass: float = 0.0
    """Which share of the bundle's range of masses is drawn from, on a logarithmic scale."""
    friction: float = 0.0
    """Which share of the bundle's range of frictions is drawn from."""
    lights: float = 0.0
    """Greatest relative change of the lights' brightness and color."""
    textures: float = 0.0
    """Greatest relative change of the things' colors."""
    camera_m: float = 0.0
    """Standard deviation of the position of the cameras that stand still."""
    camera_rad: float = 0.0
    """Standard deviation of their orientation."""
    image_noise: float = 0.0
    """Standard deviation of a color value, of 255; at every step."""
    depth_noise: float = 0.0
    """Standard deviation of depth at 1 m, in metres; it grows with the square of depth; at every step."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        for item in fields(self):
            value = getattr(self, item.name)
            most = 1.0 if item.name in ("mass", "friction", "lights", "textures") else float("inf")
            if not isinstance(value, int | float) or not 0 <= value <= most:
                raise UsageError(f"randomize: {item.name}={value!r} is not a number between 0 and {most:g}")

    @classmethod
    def everything(cls) -> "Randomization":
        """Return a moderate amount of all."""
        return cls(shift_m=0.05, turn_rad=0.5, joints_rad=0.05, mass=1.0, friction=1.0, lights=0.4, textures=0.3,
                   camera_m=0.02, camera_rad=0.03, image_noise=4.0, depth_noise=0.003)  # fmt: skip

    @classmethod
    def start(cls) -> "Randomization":
        """Return a moderate amount of what an episode begins with: poses of the things and of the robot."""
        return cls(shift_m=0.05, turn_rad=0.5, joints_rad=0.05)

    @classmethod
    def parse(cls, value: "str | dict | Randomization | None") -> "Randomization":
        """Return what an option means: None or "none", "start", "all", or a dict of the fields.

        Raises:
            UsageError: lists the fields.
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
        """Tell whether anything differs at all."""
        return any(asdict(self).values())


class Randomizer:
    """Draws and applies a `Randomization` in an environment."""

    def __init__(self, env: Any, config: Randomization) -> None:
        """Plan the groups that move together; `env` is a `SceneEnv` whose facts are known."""
        self._env, self.config = env, config
        self._entries = {entry["id"]: entry for entry in env.bundle.scene["objects"]}
        self._groups: list[Group] = []
        self._moved: list[Group] = []
        self._places: dict[int, list[np.ndarray]] = {}
        self.returned: tuple[int, ...] = ()
        """Ids of what would have fallen where this episode's draw had it, or was in its way: it stands as captured."""
        if config.shift_m or config.turn_rad:
            robot = env.robot_points if env.placement is None else env.placement.to_world(env.robot_points)
            # An arm's joints carry the hand about as far as its reach, turned by so much.
            self._groups = group_things(env.facts, robot, config.joints_rad * _ARM_M)
        self._home: dict[str, np.ndarray] = {}
        self._nominal: dict[int, tuple] = {}

    # ---- Poses.

    def poses(self, env_idx: torch.Tensor, rng: Any) -> None:
        """Move the groups in the environments `env_idx`, which have their captured poses."""
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
        """Let stand what `poses` has moved; what falls, or is in its way back, stands as captured.

        One environment on the CPU; nothing is awake afterwards.
        """
        self.returned = ()
        if not self._groups:
            return
        moved = {key for group in self._moved for key in group.members}
        self._env.builder.rest(self._env.builder.movable_ids - moved)
        if moved:
            fell = rehearse(self._env)
            for group in self._fallen(fell):
                self._place(group, [np.eye(4)])
                self.returned += tuple(key for key in group.members if key in moved)
            self._env.builder.rest()

    def _fallen(self, fell: set[int]) -> list[Group]:
        """Return the groups of what fell, and those that stand where it was captured."""
        back = [group for group in self._groups if not fell.isdisjoint(group.members)]
        for group in back:  # it grows
            self._places[id(group)] = group.outlines
            back += [
                other
                for other in self._moved
                if all(other is not one for one in back)
                and not group.clears(other, group.outlines, self._places[id(other)])
            ]
        return back

    def _place(self, group: Group, moves: list[np.ndarray]) -> None:
        """Move a group from where it was captured by transforms (4, 4), one an environment."""
        for stack in group.stacks:
            for key, start in stack.start.items():
                poses = np.stack([move @ start for move in moves])
                self._env.builder.place(key, poses, self._env.device)

    def _moves(self, draws: np.ndarray) -> list[np.ndarray]:
        """Return a transform (4, 4) a group from draws (groups, tries, 3) in [-1, 1]."""
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
        """Return where the joints are (b, d) (rad, m) in the environments `env_idx`, from those at rest (d,)."""
        out = np.repeat(qpos[None], len(env_idx), axis=0)
        if not self.config.joints_rad:
            return out
        base = 3 if traits_of(self._env.robot_uids).mobile else 0  # x, y and heading of whoever drives
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
        """Return the factors of mass and friction (b, 2) of a body, by the range of its root."""
        index = env_idx.cpu().numpy()
        draws = np.asarray(rng[index].uniform(size=2), np.float64).reshape(len(index), 2)
        entry = self._entries[body.root]
        ranges = entry.get("ranges", {})
        out = np.ones((len(index), 2))
        for column, (name, share) in enumerate(
            (("mass_kg", self.config.mass), ("friction", self.config.friction))
        ):
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
        """Forget the bodies of before: the scene was built anew."""
        self._nominal = {}
        self._home = {}

    # ---- Looks.

    def looks(self, env_idx: torch.Tensor, rng: Any) -> None:
        """Draw lights, colors and the poses of the cameras in the environments `env_idx`."""
        env = self._env
        if not env.scene.can_render() or env.scene.parallel_in_single_scene:
            return
        for number in env_idx.tolist():
            one = rng.rngs[number]
            if self.config.lights:
                _draw_lights(env.scene.sub_scenes[number], one, self.config.lights, self._home, number)
            if self.config.textures:
                for placed in {id(p.actor): p for p in env.builder.objects.values()}.values():
                    _draw_tint(placed.actor._objs[number], one, self.config.textures, self._home)
        if (self.config.camera_m or self.config.camera_rad) and not env.gpu_sim_enabled:
            for name, sensor in env._sensors.items():
                if sensor.entity is None:
                    _draw_camera(name, sensor.camera, rng.rngs[0], self.config, self._home)

    def pictures(self, data: dict, rng: Any) -> dict:
        """Return the sensors' pictures with noise, which is another one at every step."""
        if not (self.config.image_noise or self.config.depth_noise):
            return data
        for textures in data.values():
            for name, picture in textures.items():
                if name == "rgb" and self.config.image_noise:
                    noise = torch.as_tensor(_noise(rng, picture.shape), device=picture.device)
                    noisy = picture.float() + self.config.image_noise * noise
                    textures[name] = noisy.round().clamp(0, 255).to(picture.dtype)
                elif name == "depth" and self.config.depth_noise:
                    # Integers are millimetres.
                    unit = 1.0 if picture.is_floating_point() else 1e-3
                    noise = torch.as_tensor(_noise(rng, picture.shape), device=picture.device)
                    depth = picture.float() * unit
                    noisy = (depth + self.config.depth_noise * depth**2 * noise).clamp(min=0) / unit
                    noisy = noisy if picture.is_floating_point() else noisy.round().clamp(max=32767)
                    textures[name] = torch.where(picture == 0, picture, noisy.to(picture.dtype))
        return data


def _draw_lights(scene: Any, rng: np.random.RandomState, most: float, home: dict, number: int) -> None:
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
        color = np.clip(start * bright * (1 + 0.3 * most * rng.uniform(-1, 1, size=3)), 0, 4).astype(
            np.float32
        )
        if place == 0:
            scene.ambient_light = color
        else:
            lights[place - 1].color = color


def _draw_tint(entity: Any, rng: np.random.RandomState, most: float, home: dict) -> None:
    """Give an entity one of a few tints; textures hide a material's own color, so they are tinted themselves."""
    import sapien

    variant = int(rng.randint(_TINTS))
    body = entity.find_component_by_type(sapien.render.RenderBodyComponent)
    for place, shape in enumerate(body.render_shapes if body is not None else ()):
        for part_number, part in enumerate(shape.parts):
            key = ("tint", entity.name, place, part_number, entity.per_scene_id)
            if key not in home:
                home[key] = (np.array(part.material.base_color), part.material.base_color_texture)
            color, texture = home[key]
            seed = zlib.crc32(f"{entity.name} {place} {part_number} {variant}".encode())
            tint = 1 + most * np.random.RandomState(seed).uniform(-1, 1, size=3)
            if texture is None:
                part.material.base_color = [*np.clip(color[:3] * tint, 0, 1), color[3]]
                continue
            place_of_it = (*key, variant)
            if place_of_it not in home:
                home[place_of_it] = _tinted(texture, tint)
            part.material.base_color_texture = home[place_of_it]


def _tinted(texture: Any, tint: np.ndarray) -> Any:
    """Return a copy of a texture of 8 bits a color, at most 512 pixels wide, times a tint (3,)."""
    import sapien

    pixels = texture.download()
    step = max(pixels.shape[1] // _TINTED_PX, 1)
    pixels = pixels[::step, ::step].astype(np.float32)
    pixels[..., :3] *= tint
    return sapien.render.RenderTexture2D(pixels.clip(0, 255).astype(np.uint8), texture.format, srgb=True)


def _draw_camera(
    name: str, camera: Any, rng: np.random.RandomState, config: Randomization, home: dict
) -> None:
    import sapien

    if ("camera", name) not in home:
        home["camera", name] = camera.get_local_pose().sp
    start = home["camera", name]
    angles = config.camera_rad * rng.normal(size=3)
    turn = np.linalg.norm(angles)
    axis = angles / turn if turn > 0 else np.array([1.0, 0, 0])
    quat = [np.cos(turn / 2), *(np.sin(turn / 2) * axis)]
    camera.set_local_pose(start * sapien.Pose(config.camera_m * rng.normal(size=3), quat))


def _noise(rng: Any, shape: tuple[int, ...]) -> np.ndarray:
    return np.stack([one.standard_normal(size=shape[1:]).astype(np.float32) for one in rng.rngs])
