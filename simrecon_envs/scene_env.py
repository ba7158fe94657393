"""`SceneEnv`: a reconstructed scene as a ManiSkill environment, created by `gym.make("SimRecon/scene0001")`.

It delegates to `scene_options` (checks, loading), `planning` (task and place of the robot), `scene_builder` (actors),
`randomization` (resets), `measures` (simulator state), `tasks` (success, reward) and `stepping` (steps on the CPU).
"""

import logging
from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
import sapien
import torch
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils.structs.pose import Pose
from mani_skill.utils.structs.types import SceneConfig, SimConfig

from registry import EnvironmentMissing, UsageError
from simrecon_envs.arrays import Array, tensor, tensors
from simrecon_envs.backends import choose_render_backend
from simrecon_envs.cameras import room_view
from simrecon_envs.cpu_env import DirectDrive
from simrecon_envs.measures import Measures
from simrecon_envs.option_values import check_arguments, check_names, check_noise
from simrecon_envs.option_values import task_config as parse_task_config
from simrecon_envs.physics_reset import renew_physics
from simrecon_envs.placement import Target
from simrecon_envs.planning import Plan, plan_task
from simrecon_envs.randomization import Randomization, Randomizer
from simrecon_envs.robots import rest_qpos, robot_shape, traits_of
from simrecon_envs.scene_builder import SceneBuilder, scene_extent
from simrecon_envs.scene_options import REWARD_MODES, check_options, check_renderer, load_bundle
from simrecon_envs.stepping import DirectStep, as_action, check_action, flatten
from simrecon_envs.tasks import PickTaskConfig, Task, kind_of
from simrecon_envs.tasks.facts import scene_facts
from simrecon_envs.viewpoints import camera, observing_cameras, parse_cameras

logger = logging.getLogger(__name__)

# Task observations that do not reveal the state of objects; image observations contain only these.
PUBLIC = ("is_grasped", "goal_position", "stage")


class SceneEnv(BaseEnv):
    """A reconstructed scene, a robot in it, and a task.

    Observations are batched torch tensors (b parallel environments, 1 on the CPU); `simrecon_envs.make_cpu` returns
    unbatched NumPy arrays. World space: metres, +z up, floor at z = 0. Quaternions are wxyz; a pose is position and
    quaternion.

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

    `target_pose` is the pose of the target's box centre, with the object's orientation; `object_poses` are
    `world_from_object` in the order of `movable_ids`. "state" is the concatenation (b, k), float32. "rgb", "rgbd" and
    the other visual modes of ManiSkill omit the rows marked "state" and add

    | sensor_data/CAMERA/rgb       | (b, h, w, 3) | uint8   | image | -    | rgb in the mode      |
    | sensor_data/CAMERA/depth     | (b, h, w, 1) | int16   | image | mm   | z-depth, 0 = nothing  |
    | sensor_param/CAMERA/intrinsic_cv  | (b, 3, 3) | float32 | image | px  |                     |
    | sensor_param/CAMERA/extrinsic_cv  | (b, 3, 4) | float32 | camera_from_world, OpenCV axes | m | |
    | sensor_param/CAMERA/cam2world_gl  | (b, 4, 4) | float32 | world_from_camera, OpenGL axes | m | |

    CAMERA is `base_camera`, which shows the target, and the cameras of the robot (`hand_camera`, `fetch_head` …).

    Attributes: `task`, `task_note` (why the task is hard or not the requested one), `instruction`, `target_id`,
    `movable_ids`, `placement`, `bundle`, `revision_note`.

    Args:
        scene_id: Scene of the registry.
        revision: Registered revision. If the scene has a newer one, that is used, with a warning and a text in
            `revision_note`: the files of older revisions are removed.
        registry: Folder of the registry; None for the default one.
        strict_revision: Raise an error instead of using another revision.
        task: Name of a task (`list_tasks`), a kind of task ("pick", "stack" ...; chooses the easiest one in reach), or
            "none" (no success, reward 0).
        target: Subject of a kind of task: "auto" (the easiest), the id of an object, or a label.
        pose_noise: Standard deviation of a random shift (m) of each movable object at reset, or of shift and rotation
            (m, rad). Close objects may overlap.
        randomize: Randomization at reset: None, "start" (poses of objects and robot), "all", or a dict of the fields
            of `Randomization`.
        robot_uids: A robot of ManiSkill, or "none".
        cameras: Observing cameras, as a sequence or comma-separated: "workspace" (`base_camera`), "overview", "wrist",
            "capture:N" (N frames of the video). The robot's own cameras always observe.
        observe_objects: Include `object_poses` in the state. Their number differs from scene to scene.
        task_config: Thresholds of picking.
        obs_mode: As in ManiSkill; None for "state".
        render_mode: None, "rgb_array", "sensors", "all" or "human".
        renderer: "mesh", or "splats" for pictures from the Gaussians of the video, with robot and added things before
            them (`docs/splats.md`); one environment on the CPU.
        render_backend: "auto" renders only if a mode needs images; "gpu", "cpu" and "none" as in ManiSkill.
        **kwargs: Arguments of ManiSkill's `BaseEnv` (num_envs, control_mode, reward_mode, sim_backend,
            sensor_configs …).

    Raises:
        SceneNotFound: The registry has no such scene; lists the existing ones.
        SceneAssetsMissing: The files of the scene are missing or damaged, or there are no Gaussians for
            `renderer="splats"`.
        UsageError: The robot, task, target or a mode is unknown; lists the known ones.
        EnvironmentMissing: Images are requested without a usable renderer, or several environments without CUDA.
    """

    measures: Measures  # created with the scene
    _closed = False
    SUPPORTED_ROBOTS: Any = None  # all robots of ManiSkill with installed files; see `robots.usable_robots`
    SUPPORTED_OBS_MODES = ("state", "state_dict", "none", "sensor_data", "any_textures", "pointcloud")
    SUPPORTED_REWARD_MODES = REWARD_MODES

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
        randomize: str | dict[str, Any] | Randomization | None = None,
        robot_uids: str = "panda",
        cameras: str | Sequence[str] = ("workspace",),
        observe_objects: bool = True,
        task_config: PickTaskConfig | dict[str, Any] | None = None,
        obs_mode: str | None = None,
        render_mode: str | None = None,
        render_backend: str = "auto",
        renderer: str = "mesh",
        **kwargs: Any,
    ) -> None:
        check_names(task=task, target=target, cameras=cameras, obs_mode=obs_mode, render_mode=render_mode,
                    render_backend=render_backend, revision=revision)  # fmt: skip
        check_arguments(kwargs)
        check_options(scene_id, robot_uids, obs_mode, kwargs)
        check_renderer(renderer, obs_mode)
        self.bundle, self.revision_note = load_bundle(scene_id, revision, registry, strict_revision)
        self.scene_id = scene_id
        self.task_config: PickTaskConfig = parse_task_config(task_config)
        self.pose_noise = check_noise(pose_noise)
        self.randomization = Randomization.parse(randomize)
        self.facts = scene_facts(self.bundle, robot_uids)
        self.builder = SceneBuilder(self.bundle, scene_extent(self.facts.solids))
        self.movable_ids = tuple(body.root for body in self.builder.bodies if body.dynamic)
        self.robot_points = robot_shape(robot_uids).points if robot_uids != "none" else np.zeros((0, 3))
        """Points (n, 3) on the robot at rest, root space."""
        self.observe_objects = observe_objects
        self.cameras = parse_cameras(cameras)
        self._set_task(plan_task(self.facts, task, target))
        self.renderer = renderer
        self._splats = None
        if renderer == "splats":
            from simrecon_envs.splats.scene import read_splats

            self._splats = read_splats(self.bundle, self.builder.bodies, self.facts.solids)
        self._stepper: DirectStep | None = None
        self._info: dict[str, Array] = {}
        self._randomizer = Randomizer(self, self.randomization)
        super().__init__(
            obs_mode=obs_mode,
            render_mode=render_mode,
            robot_uids=robot_uids,
            render_backend=choose_render_backend(render_backend, obs_mode, render_mode),
            **kwargs,
        )

    # ---- Task and placement, chosen before the simulator is built.

    def _set_task(self, plan: Plan) -> None:
        self.placement, self.task_note = plan.placement, plan.note
        self.task = self.task_kind = "none"
        self.task_object: Task | None = None
        if plan.spec is not None:
            assert plan.placement is not None
            self.task, self.task_kind = plan.spec.name, plan.spec.kind
            self.task_object = kind_of(plan.spec)(self, plan.spec, plan.placement)
        self.target_id = self.target.id if self.target is not None else None
        if self.task_note:
            logger.info("scene %s: task %r: %s", self.scene_id, self.task, self.task_note)

    @property
    def target(self) -> Target | None:
        """Return the subject of the task at its captured pose; None without a task."""
        return self.placement.target if self.placement is not None and self.task_object is not None else None

    @property
    def instruction(self) -> str:
        """Return the task as text; "" without a task."""
        return self.task_object.instruction if self.task_object is not None else ""

    # ---- Building, once per reconfigure.

    @property
    def _default_sim_config(self) -> SimConfig:
        # The time step of the bundle's physics report card, where the objects are at rest.
        return SimConfig(
            sim_freq=240,
            control_freq=20,
            spacing=float(max(20.0, *(2 * (self.builder.extent[1] - self.builder.extent[0])[:2]))),
            scene_config=SceneConfig(contact_offset=0.01, enable_enhanced_determinism=True),
        )

    @property
    def _default_sensor_configs(self) -> list[CameraConfig]:
        return observing_cameras(self, self.cameras)

    @property
    def _default_human_render_camera_configs(self) -> list[CameraConfig]:
        view = room_view(self.bundle, self.facts.solids, self.placement, self.robot_points)
        return [camera("render_camera", view, 512)]

    def _load_agent(self, options: dict) -> None:
        super()._load_agent(options, self._root_pose() if self.placement is not None else None)
        if self.agent is not None and not self.gpu_sim_enabled:
            DirectDrive(self.agent)  # compile or load kernels here, not in the first step

    def _load_scene(self, options: dict) -> None:
        if self._splats is not None and self.gpu_sim_enabled:
            raise EnvironmentMissing(
                f"scene {self.scene_id}: renderer='splats' draws one environment on the CPU, and {self.num_envs} are "
                f"simulated on a GPU here; use simrecon_envs.make_vec({self.scene_id!r}, {self.num_envs}, "
                "renderer='splats'), or renderer='mesh'"
            )
        pedestal = None
        if self.placement is not None and self.placement.pedestal_m > 0.01:
            # 2 mm below the robot, so that the two do not touch.
            top = self.placement.position - [0, 0, 0.002]
            radius = 0.8 * traits_of(str(self.robot_uids)).footprint_radius_m
            pedestal = (top, self.placement.pedestal_m - 0.004, radius)
        self.builder.build(self.scene, pedestal)
        self.measures = Measures(self)
        self._randomizer.rebuilt()
        if self.gpu_sim_enabled:
            every = torch.arange(self.num_envs, device=self.device)
            self._randomizer.physics(every, self._batched_episode_rng)

    def _load_lighting(self, options: dict) -> None:
        # Textures from the video contain the room's shading: mostly ambient light shows them nearly as filmed. The rest
        # shapes the robot and added things.
        self.scene.set_ambient_light([0.8, 0.8, 0.8])
        self.scene.add_directional_light([0.4, 0.3, -1.0], [0.4, 0.4, 0.39], shadow=self.enable_shadow)
        self.scene.add_directional_light([-0.5, -0.6, -0.6], [0.15, 0.15, 0.165])

    def _setup_sensors(self, options: dict) -> None:
        super()._setup_sensors(options)
        if self._splats is not None and self.scene.can_render():
            from simrecon_envs.splats.cameras import attach  # imports Numba and compiles kernels

            self._randomizer.layer = attach(self, self._splats)

    def _root_pose(self) -> sapien.Pose:
        assert self.placement is not None  # there is a robot
        p: Any = self.placement.position
        q: Any = self.placement.quat_wxyz
        return sapien.Pose(p, q)

    # ---- Episodes.

    def reset(self, seed: int | list[int] | None = None, options: dict | None = None) -> tuple[Any, dict]:
        """Reset as in ManiSkill; also seed Gymnasium's generator, as its checker expects."""
        self._require_open()
        if seed is not None:
            gym.Env.reset(self, seed=int(np.ravel(seed)[0]))
        return super().reset(seed=seed, options=options)

    def close(self) -> None:
        """Close the simulator; a second call does nothing."""
        if not self._closed:
            self._closed = True
            super().close()

    def _require_open(self) -> None:
        if self._closed:
            raise UsageError(f"scene {self.scene_id}: the environment is closed; make it again with gym.make")

    def step(self, action: "np.ndarray | torch.Tensor | Sequence[float] | dict | None") -> tuple:
        """Step as in ManiSkill; controllers that normalize actions clip them to [-1, 1].

        Raises:
            UsageError: The action does not have the shape of the action space, or is not finite; or the environment is
                closed.
        """
        self._require_open()
        given: Any = as_action(self, action)
        numbers = isinstance(given, (np.ndarray, torch.Tensor))
        if self.gpu_sim_enabled:
            if numbers:
                check_action(self, given)
            return super().step(given)
        stepper = self._stepper
        if stepper is None or not stepper.current:
            stepper = self._stepper = DirectStep(self)
        return stepper.outcome(stepper.simulate(given) if numbers else super()._step_action(given))

    def _clear_sim_state(self) -> None:
        if not self.gpu_sim_enabled:
            renew_physics(self)
        super()._clear_sim_state()

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        self.builder.initialize(env_idx, self.device, self.pose_noise, self._batched_episode_rng)
        if not self.gpu_sim_enabled and not any(self.pose_noise):
            self.builder.rest()  # objects moved from here on wake up
        qpos = None
        if self.agent is not None:
            qpos = self._randomizer.joints(env_idx, self._batched_episode_rng, rest_qpos(self.agent))
        self._randomizer.poses(env_idx, self._batched_episode_rng)
        if not self.gpu_sim_enabled:  # on the GPU, masses and frictions cannot change after building
            self._randomizer.physics(env_idx, self._batched_episode_rng)
            self._randomizer.settle()
        if self.agent is not None:
            self.agent.reset(torch.as_tensor(qpos, dtype=torch.float32, device=self.device))
            root: Any = Pose.create(self._root_pose(), device=self.device)
            self.agent.robot.set_pose(root)
        self._randomizer.looks(env_idx, self._batched_episode_rng)
        self.measures.forget(env_idx)
        if self.task_object is not None:
            self.task_object.start(env_idx, self._batched_episode_rng)

    def get_state_dict(self) -> dict:
        """Return the simulation's state; without a robot, it has no controller state."""
        state: Any = super().get_state_dict() if self.agent is not None else self.scene.get_sim_state()
        return state

    # ---- Task.

    @property
    def target_position(self) -> torch.Tensor:
        """Return the target's box centre (num_envs, 3), world, metres."""
        assert self.target_id is not None  # there is a task
        return tensor(self.measures.position(self.target_id))

    def get_info(self) -> dict:
        """Return `evaluate` and the number of steps."""
        if self._stepper is None:
            return super().get_info()
        return {"elapsed_steps": self._elapsed_steps, **self.evaluate()}

    def steps_done(self) -> int:
        """Return the number of steps in the episode of the first environment."""
        return int(self._elapsed_steps[0]) if self._stepper is None else self._stepper.steps

    def evaluate(self) -> dict:
        """Return "success" of the task and the values that it depends on."""
        self.measures.refresh()
        self._info = self.task_object.evaluate() if self.task_object is not None else {}
        return tensors(self._info)

    def compute_dense_reward(self, obs: Any, action: torch.Tensor, info: dict) -> torch.Tensor:
        """Return the reward (num_envs,) in [0, `max_reward` of the task]; 0 without a task."""
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
        """Return 1 for success, else 0 (num_envs,)."""
        if self.task_object is None:
            return torch.zeros(self.num_envs, device=self.device)
        return info["success"].float()

    # ---- Observations.

    def get_obs(self, info: dict | None = None, unflattened: bool = False) -> Any:
        """Return the observation, without the empty "sensor_data" of point clouds, which Gymnasium forbids."""
        obs = super().get_obs(info, unflattened)
        if isinstance(obs, dict) and not obs.get("sensor_data", True):
            del obs["sensor_data"]
        return obs

    def get_sensor_params(self) -> dict[str, dict[str, torch.Tensor]]:
        """Return copies of the cameras' parameters, because the caller may keep observations."""
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
        """Return the observations except joints and images, as of the last `evaluate`."""
        out = {}
        if hasattr(self.agent, "tcp"):
            out["tcp_pose"] = self.measures.tcp
        told = self.task_object.observe(self._info) if self.task_object is not None else {}
        if not self.obs_mode_struct.use_state:
            return out | {key: value for key, value in told.items() if key.endswith(PUBLIC)}
        out |= told
        if self.movable_ids and self.observe_objects:
            out["object_poses"] = self.measures.poses.reshape(self.num_envs, -1)
        return out

    def _get_obs_extra(self, info: dict) -> dict:
        return tensors(self.known())
