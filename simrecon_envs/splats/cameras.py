"""Cameras of an environment whose pictures show its Gaussians."""

from typing import Any

import numpy as np
import sapien
import torch
from mani_skill.sensors.camera import Camera

from registry import UsageError
from registry.geometry import invert_rigid
from simrecon_envs.scene_builder import show_unlit
from simrecon_envs.splats.compositing import Actors, Picture, composite, limits_of
from simrecon_envs.splats.rasterizer import Rasterizer
from simrecon_envs.splats.scene import SplatScene
from simrecon_envs.splats.shadows import Caster, darken, shadow_map

_STATIC_MARGIN_M = 0.10  # Gaussians this far behind the mesh of a thing that stands as captured still show
_MOVED_MARGIN_M = 0.02  # and of a thing that was moved: less, because behind it is what it came to cover
_MOVED_M = 1e-3  # beyond this shift of any of its Gaussians' centers a thing counts as moved
_BASE_MARGIN_M = 1e6  # what was seen behind an open door was seen
_MOST_MM = 32767


class SplatLayer:
    """The Gaussians of a `SceneEnv` with one environment on the CPU, and what its SAPIEN actors are to them."""

    def __init__(self, env: Any, scene: SplatScene) -> None:
        """Read the built actors of an environment; the meshes of the scene become unlit, as filmed."""
        self._env, self._scene = env, scene
        self._rasterizer = Rasterizer(scene)
        self.gain = np.ones(3, np.float32)
        """Brightness and color of the room's light as drawn by `randomize`."""
        actors = [env.builder.carrying_actors(key)[0] for key in scene.keys]
        self._entities = [actor._objs[0] for actor in actors]
        self._body_from_world = np.array([invert_rigid(pose) for pose in scene.world_from_body])
        movable = set(env.builder.movable_ids)
        self._movable = np.array([False, *(key in movable for key in scene.keys)])
        grounds = [
            actor._objs[0] for base in env.bundle.base for actor in env.builder.carrying_actors(base.id)[1:]
        ]
        for entity in (*self._entities, *grounds):
            show_unlit(entity)
        behind = env.builder.backdrop
        backdrops = [] if behind is None else [behind._objs[0]]
        self._actors = self._table(len(env.bundle.base), [*grounds, *backdrops])
        self._moving = {row: Caster(self._entities[row - 1]) for row in np.flatnonzero(self._movable)}
        self._added = [
            Caster(entity)
            for entity in env.scene.sub_scenes[0].entities
            if self._actors.body[entity.per_scene_id] < 0
        ]

    def _table(self, bases: int, behind: list[sapien.Entity]) -> Actors:
        """Describe all actors; those of `bases`, and the entities `behind`, hide no Gaussian."""
        ids = [entity.per_scene_id for entity in self._entities]
        size = 1 + max(entity.per_scene_id for entity in self._env.scene.sub_scenes[0].entities)
        actors = Actors(
            body=np.full(size, -1, np.int32),
            margin_m=np.zeros(size, np.float32),
            tint=np.ones((size, 3), np.float32),
            segmentation=np.array([0, *ids], np.int16),
        )
        for row, key in enumerate(ids, 1):
            actors.body[key], actors.margin_m[key] = row, _STATIC_MARGIN_M
        for key in (0, *ids[:bases], *(entity.per_scene_id for entity in behind)):
            actors.body[key], actors.margin_m[key] = max(int(actors.body[key]), 0), _BASE_MARGIN_M
        return actors

    def tint(self, entity: sapien.Entity, factor: np.ndarray) -> None:
        """Multiply the colors of an actor, its mesh's and its Gaussians', by a factor (3,)."""
        row = int(self._actors.body[entity.per_scene_id])
        self._actors.tint[entity.per_scene_id] = factor
        mine = self._scene.bodies == row
        self._rasterizer.colors[mine] = self._scene.colors[mine] * np.asarray(factor, np.float32)

    def moves(self) -> np.ndarray:
        """Return for each body the transform (b, 4, 4), in world space, since the capture."""
        now = np.repeat(np.eye(4)[None], len(self._body_from_world), axis=0)
        for row in np.flatnonzero(self._movable):
            now[row] = self._entities[row - 1].pose.to_transformation_matrix() @ self._body_from_world[row]
        return now

    def show(self, picture: Picture, extrinsic: np.ndarray, intrinsics: np.ndarray) -> Picture:
        """Return SAPIEN's picture of a camera with the Gaussians before it.

        Args:
            picture: SAPIEN's.
            extrinsic: camera_from_world (3, 4), OpenCV axes.
            intrinsics: (3, 3).
        """
        moves, actors = self.moves(), self._actors
        still = np.abs(moves - np.eye(4)).max(axis=(1, 2)) < _MOVED_M
        for row in np.flatnonzero(self._movable):
            margin = _STATIC_MARGIN_M if still[row] else _MOVED_MARGIN_M
            actors.margin_m[actors.segmentation[row]] = margin
        limits, owners = limits_of(picture, actors)
        lens = np.array([intrinsics[0, 0], intrinsics[1, 1], intrinsics[0, 2], intrinsics[1, 2]], np.float64)
        drawn = self._rasterizer.draw(
            extrinsic.astype(np.float64) @ moves, lens, limits, owners, threads=torch.get_num_threads()
        )
        casters = [*self._added, *(caster for row, caster in self._moving.items() if not still[row])]
        shadows = shadow_map(np.concatenate([np.zeros((0, 3)), *(caster.in_world() for caster in casters)]))

        def shade(colors: np.ndarray, depth_mm: np.ndarray) -> None:
            if shadows is not None:
                receives = (owners >= 0) & (still | ~self._movable)[owners]
                pose = invert_rigid(np.vstack([extrinsic, [0, 0, 0, 1]]).astype(np.float64))
                darken(colors, depth_mm, receives, pose, lens, shadows.origin, shadows.cover, shadows.lowest)

        return composite(picture, actors, drawn, self._scene.bodies, self.gain, shade)


class SplatCamera(Camera):
    """A camera of ManiSkill whose color, depth, position and segmentation are those of a `SplatLayer`."""

    def __init__(self, camera: Camera, layer: SplatLayer) -> None:
        """Take over a camera."""
        self.__dict__.update(camera.__dict__)
        self._layer = layer

    def get_obs(
        self,
        rgb: bool = True,
        depth: bool = True,
        position: bool = True,
        segmentation: bool = True,
        normal: bool = False,
        albedo: bool = False,
        apply_texture_transforms: bool = True,
    ) -> dict[str, torch.Tensor]:
        """Return the images as ManiSkill does; normals and albedo are those of the meshes."""
        if not apply_texture_transforms:
            raise UsageError(
                "obs_mode 'sensor_data' has SAPIEN's raw images; renderer='splats' draws 'rgb', 'rgb+depth' …"
            )
        found = super().get_obs(True, True, position, True, normal, albedo)
        picture = Picture(*(_numpy(found[name]) for name in ("rgb", "depth", "segmentation")))
        component = self.camera._render_cameras[0]
        extrinsic, lens = component.get_extrinsic_matrix(), component.get_intrinsic_matrix()
        shown = self._layer.show(picture, extrinsic, lens)
        images = {
            "rgb": shown.rgb,
            "depth": shown.depth_mm[..., None],
            "segmentation": shown.segmentation[..., None],
        }
        if position:
            images["position"] = _positions(shown.depth_mm, lens)
        for name, image in images.items():
            found[name] = torch.from_numpy(image)[None].to(found[name].device)
        wanted = {"rgb": rgb, "depth": depth, "segmentation": segmentation}
        return {name: image for name, image in found.items() if wanted.get(name, True)}


def _numpy(image: torch.Tensor) -> np.ndarray:
    array = image[0].cpu().numpy()
    return np.ascontiguousarray(array if array.shape[-1] == 3 else array[..., 0])


def _positions(depth_mm: np.ndarray, lens: np.ndarray) -> np.ndarray:
    """Return camera-space positions int16 (h, w, 3) in mm, OpenGL axes, as SAPIEN's."""
    height, width = depth_mm.shape
    z = depth_mm.astype(np.float32)
    x = (np.arange(width, dtype=np.float32) + 0.5 - lens[0, 2]) / lens[0, 0] * z
    y = (np.arange(height, dtype=np.float32)[:, None] + 0.5 - lens[1, 2]) / lens[1, 1] * z
    return np.stack([x, -y, -z], axis=-1).clip(-_MOST_MM, _MOST_MM).astype(np.int16)


def attach(env: Any, scene: SplatScene) -> SplatLayer:
    """Replace the built cameras of a `SceneEnv` by `SplatCamera`s; return their layer.

    Raises:
        UsageError: A camera is not a plain one.
    """
    layer = SplatLayer(env, scene)
    for cameras in (env._sensors, env._human_render_cameras):
        for name, camera in cameras.items():
            if type(camera) is not Camera:
                raise UsageError(
                    f"camera {name}: renderer='splats' draws plain cameras, not {type(camera).__name__}; "
                    "use renderer='mesh'"
                )
            cameras[name] = SplatCamera(camera, layer)
    return layer
