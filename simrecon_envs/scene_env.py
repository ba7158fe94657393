"""`SceneEnv`: one reconstructed scene as a ManiSkill environment, made by
`gym.make("SimRecon/scene0001")`.
"""

import logging
import warnings
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import sapien
import torch
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.envs.utils.observations import parse_obs_mode_to_struct
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils.structs.pose import Pose
from mani_skill.utils.structs.types import SceneConfig, SimConfig

from registry import (
    BundleError,
    EnvironmentMissing,
    SceneBundle,
    SceneNotFound,
    SceneRegistry,
    UsageError,
    default_registry_root,
)
from registry.errors import did_you_mean
from simrecon_envs.arrays import Array, tensor, tensors
from simrecon_envs.backends import choose_render_backend
from simrecon_envs.cameras import room_view
from simrecon_envs.cpu_env import DirectDrive
from simrecon_envs.errors import SceneAssetsMissing
from simrecon_envs.measures import Measures
from simrecon_envs.physics_reset import renew_physics
from simrecon_envs.placement import Target
from simrecon_envs.planning import Plan, plan_task
from simrecon_envs.randomization import Randomization, Randomizer
from simrecon_envs.robots import (
    RobotShape,
    check_control_mode,
    check_robot,
    rest_qpos,
    robot_shape,
    traits_of,
)
from simrecon_envs.scene_builder import SceneBuilder, scene_extent
from simrecon_envs.stepping import DirectStep, check_action, flatten
from simrecon_envs.tasks import PickTaskConfig, kind_of
from simrecon_envs.tasks.facts import scene_facts
from simrecon_envs.viewpoints import camera, observing_cameras, parse_cameras

logger = logging.getLogger(__name__)

OBS_MODES = (
    "state", "state_dict", "none", "rgb", "depth", "segmentation", "rgbd", "pointcloud", "sensor_data",
)  # fmt: skip
# What observations with pictures keep of a task's own: touch, and what the robot was told.
PUBLIC = ("is_grasped", "goal_position", "stage")


class SceneEnv(BaseEnv):
    """One reconstructed scene, a robot in it, and a task.

    Observations are batched torch tensors (b = number of parallel environments, 1 on the CPU);
    `simrecon_envs.make_cpu` removes the batch and gives NumPy. World space: metres, +z up, floor at z = 0;
    quaternions wxyz; a pose is position then quaternion.

    | key (obs_mode "state_dict")  | shape        | dtype   | space | unit | only where           |
    |------------------------------|--------------|---------|-------|------|----------------------|
    | agent/qpos                   | (b, d)       | float32 | joint | rad, m | there is a robot   |
    | agent/qvel                   | (b, d)       | float32 | joint | rad/s, m/s | there is a robot |
    | extra/tcp_pose               | (b, 7)       | float32 | world | m, - | the robot has a hand |
    | extra/is_grasped             | (b, 1)       | bool    | -     | -    | tasks that lift      |
    | extra/goal_position          | (b, 3)       | float32 | world | m    | tasks with a goal    |
    | extra/target_pose            | (b, 7)       | float32 | world | m, - | tasks of the hand, state |
    | extra/tcp_to_target          | (b, 3)       | float32 | world | m    | tasks of the hand, state |
    | extra/target_to_goal         | (b, 3)       | float32 | world | m    | tasks with a goal, state |
    | extra/target_lift            | (b, 1)       | float32 | world | m    | "pick", state        |
    | extra/object_poses           | (b, 7 n)     | float32 | world | m, - | n > 0 movable objects, state |

    `target_pose` is that of the target's box centre (with the object's orientation); `object_poses` are the
    bundle's `world_from_object`, in the order of `movable_ids`. "state" is all of this in one (b, k) float32
    vector. "rgb", "rgbd" and the other visual modes of ManiSkill leave out the rows marked "state" and add

    | sensor_data/CAMERA/rgb       | (b, h, w, 3) | uint8   | image | -    | rgb in the mode      |
    | sensor_data/CAMERA/depth     | (b, h, w, 1) | int16   | image | mm   | z-depth, 0 = nothing  |
    | sensor_param/CAMERA/intrinsic_cv  | (b, 3, 3) | float32 | image | px  |                     |
    | sensor_param/CAMERA/extrinsic_cv  | (b, 3, 4) | float32 | camera_from_world, OpenCV axes | m | |
    | sensor_param/CAMERA/cam2world_gl  | (b, 4, 4) | float32 | world_from_camera, OpenGL axes | m | |

    CAMERA is `base_camera`, which overlooks the target, and whatever the robot carries (`hand_camera`,
    `fetch_head` …).

    Attributes: `task`, `task_note` (why the task is not what was asked for, or hard), `instruction`,
    `target_id`, `movable_ids`, `placement`, `bundle`, `revision_note`.
    """

    SUPPORTED_ROBOTS = None  # every robot of ManiSkill whose files are here; see `robots.usable_robots`
    SUPPORTED_OBS_MODES = ("state", "state_dict", "none", "sensor_data", "any_textures", "pointcloud")
    SUPPORTED_REWARD_MODES = ("normalized_dense", "dense", "sparse", "none")

    def __init__(
        self,
        scene_id: str,
        revision: str | None = None,
        registry: str | None = None,
        *,
        strict_revision: bool = False,
        task: str = "pick",
        target: str | int = "auto",
        pose_noise: float | tuple[float, float] = 0.0,
        randomize: str | dict | Randomization | None = None,
        robot_uids: str = "panda",
        cameras: str | list | tuple = ("workspace",),
        observe_objects: bool = True,
        task_config: PickTaskConfig | dict | None = None,
        obs_mode: str | None = None,
        render_mode: str | None = None,
        render_backend: str = "auto",
        **kwargs: Any,
    ) -> None:
        """Load the scene and build it.

        Args:
            scene_id: Scene of the registry.
            revision: Which revision of it was registered. Where the scene has a newer one by now, the newer
                one is used, with a warning and a text in `revision_note`: the old files are gone with it.
            registry: The registry's folder; the default registry where None.
            strict_revision: Raise instead of using another revision.
            task: A task's name (`list_tasks`), a kind of task ("pick", "stack" ...; the easiest of it that the
                robot reaches), or "none" (no success, reward 0).
            target: What a kind of task is about: "auto" (the easiest), an object's id, or a label.
            pose_noise: Standard deviation of a random shift of each movable object at reset (m), or of shift
                and turn (m, rad). A little noise can make objects overlap where they stand close together.
            randomize: What differs from reset to reset: None, "start" (poses of things and robot), "all", or a dict
                of `Randomization`'s fields.
            robot_uids: A robot of ManiSkill, or "none".
            cameras: Which cameras observe, by name or names with commas: "workspace" (`base_camera`), "overview",
                "wrist", "capture:N" (N frames of the video). What the robot carries observes anyway.
            observe_objects: Have `object_poses` in the state, whose length differs from scene to scene.
            task_config: Thresholds of picking.
            obs_mode: As in ManiSkill; "state" where None.
            render_mode: None, "rgb_array", "sensors", "all" or "human".
            render_backend: "auto" renders only if a mode asks for pictures; "gpu", "cpu" and "none" as in
                ManiSkill.
            **kwargs: As for ManiSkill's `BaseEnv` (num_envs, control_mode, reward_mode, sim_backend,
                sensor_configs …).

        Raises:
            SceneNotFound: the registry has no such scene; the message lists what there is.
            SceneAssetsMissing: its files are gone or damaged.
            UsageError: no such robot, task, target or mode; the message lists what there is.
            EnvironmentMissing: pictures were asked for, and nothing can render here; or several environments,
                and there is no CUDA.
        """
        if not isinstance(robot_uids, str):
            raise UsageError(
                f"scene {scene_id}: robot_uids: expected the name of one robot, got {robot_uids!r}"
            )
        if robot_uids != "none":
            check_robot(robot_uids)
            check_control_mode(robot_uids, kwargs.get("control_mode"))
        _check_options(scene_id, obs_mode, kwargs)
        self.bundle, self.revision_note = _load(scene_id, revision, registry, strict_revision)
        self.scene_id = scene_id
        self.task_config = PickTaskConfig(**task_config) if isinstance(task_config, dict) else task_config
        self.task_config = self.task_config or PickTaskConfig()
        self.pose_noise = (pose_noise, 0.0) if np.isscalar(pose_noise) else tuple(pose_noise)
        self.facts = scene_facts(self.bundle, robot_uids)
        self._solids = self.facts.solids
        self.builder = SceneBuilder(self.bundle, scene_extent(self._solids))
        self.movable_ids = tuple(body.root for body in self.builder.bodies if body.dynamic)
        self._shape = (
            robot_shape(robot_uids) if robot_uids != "none" else RobotShape(np.zeros((0, 3)), None, False)
        )
        self.observe_objects = observe_objects
        self.cameras = parse_cameras(cameras)
        self._apply(plan_task(self.facts, task, target))
        self.measures: Measures | None = None
        self._stepper: DirectStep | None = None
        self._info: dict[str, Array] = {}
        self.randomization = Randomization.parse(randomize)
        self._randomizer = Randomizer(self, self.randomization)
        super().__init__(
            obs_mode=obs_mode,
            render_mode=render_mode,
            robot_uids=robot_uids,
            render_backend=choose_render_backend(render_backend, obs_mode, render_mode),
            **kwargs,
        )

    # ---- What the task and the placement are; decided before anything is built.

    def _apply(self, plan: Plan) -> None:
        self.placement, self.task_note = plan.placement, plan.note
        self.task = plan.spec.name if plan.spec is not None else "none"
        self.task_kind = plan.spec.kind if plan.spec is not None else "none"
        self.task_object = (
            kind_of(plan.spec)(self, plan.spec, plan.placement) if plan.spec is not None else None
        )
        self.target_id = plan.placement.target.id if self.task_object is not None else None
        if self.task_note:
            logger.info("scene %s: task %r: %s", self.scene_id, self.task, self.task_note)

    @property
    def target(self) -> Target | None:
        """Return what the task is about, measured as it was captured; None without a task."""
        return self.placement.target if self.task_object is not None else None

    @property
    def instruction(self) -> str:
        """Return the task in words."""
        return self.task_object.instruction if self.task_object is not None else ""

    # ---- Building; once per reconfigure.

    @property
    def _default_sim_config(self) -> SimConfig:
        # The timestep of the bundle's physics report: objects rest as quietly here as they did there.
        return SimConfig(
            sim_freq=240,
            control_freq=20,
            spacing=float(max(20.0, *(2 * (self.builder.extent[1] - self.builder.extent[0])[:2]))),
            scene_config=SceneConfig(contact_offset=0.01, enable_enhanced_determinism=True),
        )

    @property
    def robot_points(self) -> np.ndarray:
        """Return points (n, 3) on the robot at rest, in its root space."""
        return self._shape.points

    @property
    def _default_sensor_configs(self) -> list[CameraConfig]:
        return observing_cameras(self, self.cameras)

    @property
    def _default_human_render_camera_configs(self) -> list[CameraConfig]:
        view = room_view(self.bundle, self._solids, self.placement, self._shape.points)
        return [camera("render_camera", view, 512)]

    def _load_agent(self, options: dict) -> None:
        super()._load_agent(options, self._root_pose() if self.placement is not None else None)
        if self.agent is not None and not self.gpu_sim_enabled:
            DirectDrive(self.agent)  # loads what is compiled: that belongs to making, not to the first step

    def _load_scene(self, options: dict) -> None:
        pedestal = None
        if self.placement is not None and self.placement.pedestal_m > 0.01:
            # A hair below the robot, so that the two do not touch.
            top = self.placement.position - [0, 0, 0.002]
            radius = 0.8 * traits_of(self.robot_uids).footprint_radius_m
            pedestal = (top, self.placement.pedestal_m - 0.004, radius)
        self.builder.build(self.scene, pedestal)
        self.measures = Measures(self)
        self._randomizer.rebuilt()
        if self.gpu_sim_enabled:
            every = torch.arange(self.num_envs, device=self.device)
            self._randomizer.physics(every, self._batched_episode_rng)

    def _load_lighting(self, options: dict) -> None:
        # The textures come from a video and carry the room's light already: mostly ambient, a little shape.
        self.scene.set_ambient_light([0.6, 0.6, 0.6])
        self.scene.add_directional_light([0.4, 0.3, -1.0], [0.8, 0.8, 0.78], shadow=self.enable_shadow)
        self.scene.add_directional_light([-0.5, -0.6, -0.6], [0.3, 0.3, 0.33])

    def _root_pose(self) -> sapien.Pose:
        return sapien.Pose(self.placement.position, self.placement.quat_wxyz)

    # ---- Episodes.

    def reset(self, seed: int | list[int] | None = None, options: dict | None = None) -> tuple[Any, dict]:
        """Reset as ManiSkill does; Gymnasium's own generator is seeded, too, as its checker expects."""
        if seed is not None:
            gym.Env.reset(self, seed=int(np.ravel(seed)[0]))
        return super().reset(seed=seed, options=options)

    def step(self, action: np.ndarray | torch.Tensor | dict | None) -> tuple:
        """Step as ManiSkill does; actions outside [-1, 1] are clipped where the controller normalizes them.

        Raises:
            UsageError: the action has another shape than the action space, or is not finite.
        """
        numbers = isinstance(action, (np.ndarray, torch.Tensor))
        if self.gpu_sim_enabled:
            if numbers:
                check_action(self, action)
            return super().step(action)
        stepper = self._stepper
        if stepper is None or not stepper.current:
            stepper = self._stepper = DirectStep(self)
        action = stepper.simulate(action) if numbers else super()._step_action(action)
        return stepper.outcome(action)

    def _clear_sim_state(self) -> None:
        if not self.gpu_sim_enabled:
            renew_physics(self)
        super()._clear_sim_state()

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        self.builder.initialize(env_idx, self.device, self.pose_noise, self._batched_episode_rng)
        if not self.gpu_sim_enabled and not any(self.pose_noise):
            self.builder.rest()  # what is moved from here on wakes up
        qpos = None
        if self.agent is not None:
            qpos = self._randomizer.joints(env_idx, self._batched_episode_rng, rest_qpos(self.agent))
        self._randomizer.poses(env_idx, self._batched_episode_rng)
        if not self.gpu_sim_enabled:  # on the GPU they are fixed once the simulation runs
            self._randomizer.physics(env_idx, self._batched_episode_rng)
            self._randomizer.settle()
        if self.agent is not None:
            self.agent.reset(torch.as_tensor(qpos, dtype=torch.float32, device=self.device))
            self.agent.robot.set_pose(Pose.create(self._root_pose(), device=self.device))
        self._randomizer.looks(env_idx, self._batched_episode_rng)
        self.measures.forget(env_idx)
        if self.task_object is not None:
            self.task_object.start(env_idx, self._batched_episode_rng)

    def get_state_dict(self) -> dict:
        """Return the simulation's state; without a robot there is no controller to ask."""
        return super().get_state_dict() if self.agent is not None else self.scene.get_sim_state()

    # ---- Task.

    @property
    def target_position(self) -> torch.Tensor:
        """Return where the target's box centre is (num_envs, 3), world, metres."""
        return tensor(self.measures.position(self.target_id))

    def get_info(self) -> dict:
        """Return how many steps were taken and what `evaluate` says."""
        if self._stepper is None:
            return super().get_info()
        return {"elapsed_steps": self._elapsed_steps, **self.evaluate()}

    def steps_done(self) -> int:
        """Return how many steps the episode of the first environment has had."""
        return int(self._elapsed_steps[0]) if self._stepper is None else self._stepper.steps

    def evaluate(self) -> dict:
        """Return whether the task is done, and what that depends on."""
        self.measures.refresh()
        self._info = self.task_object.evaluate() if self.task_object is not None else {}
        return tensors(self._info)

    def compute_dense_reward(self, obs: Any, action: torch.Tensor, info: dict) -> torch.Tensor:
        """Return the reward (num_envs,) between 0 and the task's `max_reward`; 0 without a task."""
        return self._reward(1.0)

    def compute_normalized_dense_reward(self, obs: Any, action: torch.Tensor, info: dict) -> torch.Tensor:
        """Return the reward (num_envs,) in [0, 1]."""
        return self._reward(1.0 if self.task_object is None else self.task_object.max_reward)

    def _reward(self, most: float) -> torch.Tensor:
        if self.task_object is None:
            return torch.zeros(self.num_envs, device=self.device)
        reward = self.task_object.reward(self._info)
        if isinstance(reward, torch.Tensor):
            return reward / most
        return tensor(reward / np.float32(most))

    def compute_sparse_reward(self, obs: Any, action: torch.Tensor, info: dict) -> torch.Tensor:
        """Return 1 where the task is done, else 0 (num_envs,)."""
        if self.task_object is None:
            return torch.zeros(self.num_envs, device=self.device)
        return info["success"].float()

    # ---- Observations.

    def get_obs(self, info: dict | None = None, unflattened: bool = False) -> Any:
        """Return the observation; ManiSkill's point clouds leave an empty "sensor_data", which Gymnasium forbids."""
        obs = super().get_obs(info, unflattened)
        if isinstance(obs, dict) and not obs.get("sensor_data", True):
            del obs["sensor_data"]
        return obs

    def get_sensor_params(self) -> dict[str, dict[str, torch.Tensor]]:
        """Return the cameras' parameters; copies, since whoever gets an observation may keep it."""
        known = super().get_sensor_params()
        return {name: {key: value.clone() for key, value in of.items()} for name, of in known.items()}

    def _get_obs_sensor_data(self, apply_texture_transforms: bool = True) -> dict:
        data = super()._get_obs_sensor_data(apply_texture_transforms)
        return self._randomizer.pictures(data, self._batched_episode_rng)

    def _flatten_raw_obs(self, obs: Any) -> Any:
        flat = flatten(obs) if self._obs_mode == "state" and not self.gpu_sim_enabled else None
        return super()._flatten_raw_obs(obs) if flat is None else flat

    def _get_obs_agent(self) -> dict:
        return super()._get_obs_agent() if self.agent is not None else {}

    def known(self) -> dict[str, Array]:
        """Return what an agent is told besides its own joints, as of the last `evaluate`."""
        out = {}
        if hasattr(self.agent, "tcp"):
            out["tcp_pose"] = self.measures.tcp
        told = self.task_object.observe(self._info) if self.task_object is not None else {}
        if not self.obs_mode_struct.use_state:
            # What a robot knows without being told where things are: its own touch, and the goal it was given.
            return out | {key: value for key, value in told.items() if key.endswith(PUBLIC)}
        out |= told
        if self.movable_ids and self.observe_objects:
            out["object_poses"] = self.measures.poses.reshape(self.num_envs, -1)
        return out

    def _get_obs_extra(self, info: dict) -> dict:
        return tensors(self.known())


def _check_options(scene_id: str, obs_mode: str | None, options: dict) -> None:
    """Make sure of what ManiSkill would find wrong only later, and in its own words."""
    try:
        parse_obs_mode_to_struct(obs_mode or "state")
    except AssertionError as error:
        raise UsageError(
            f"obs_mode {obs_mode!r}: expected {', '.join(OBS_MODES)}, or several with + in between."
            + did_you_mean(str(obs_mode), OBS_MODES)
        ) from error
    reward_mode, modes = options.get("reward_mode"), SceneEnv.SUPPORTED_REWARD_MODES
    if reward_mode not in (None, *modes):
        near = did_you_mean(str(reward_mode), modes)
        raise UsageError(f"reward_mode {reward_mode!r}: expected one of {', '.join(modes)}.{near}")
    count = options.get("num_envs", 1)
    if count > 1 and not torch.cuda.is_available():
        raise EnvironmentMissing(
            f"num_envs={count} is simulated on a GPU, and there is no CUDA here; "
            f"simrecon_envs.make_vec({scene_id!r}, {count}) starts one process an environment"
        )


def _load(scene_id: str, revision: str | None, registry: str | None, strict: bool) -> tuple[SceneBundle, str]:
    """Open the scene's current revision; return it and a note where it is not the one that was asked for."""
    root = Path(registry) if registry is not None else default_registry_root()
    catalog = SceneRegistry(root)
    try:
        bundle = catalog.load(scene_id)
    except SceneNotFound as error:
        raise SceneNotFound(
            f"{error}. Call simrecon_envs.register_scenes() to see what the registry has now"
        ) from error
    except BundleError as error:
        option = "" if registry is None else f" --registry {root}"
        raise SceneAssetsMissing(
            f"scene {scene_id}: its files in {root} are gone or damaged: {error}. "
            f"`simrecon verify {scene_id}{option}` says more; make it again with "
            f"`simrecon reconstruct VIDEO --scene {scene_id}{option}`"
        ) from error
    if revision is None or bundle.revision == revision:
        return bundle, ""
    note = f"scene {scene_id}: revision {revision} was replaced by {bundle.revision}, which is used"
    if strict:
        raise SceneAssetsMissing(
            f"scene {scene_id}: revision {revision} was replaced by {bundle.revision}; call "
            "simrecon_envs.register_scenes() to register the new one, or leave out strict_revision"
        )
    warnings.warn(note, stacklevel=3)
    return bundle, note
