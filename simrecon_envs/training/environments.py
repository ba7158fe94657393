"""Make the environments for training and evaluation: NumPy, in one process each for training."""

import multiprocessing
import signal
import time
from typing import Any

import gymnasium as gym
import numpy as np

from registry import UsageError
from simrecon_envs.processes import in_worker, start_method
from simrecon_envs.registration import episode_steps, make_cpu
from simrecon_envs.training.config import TrainConfig
from simrecon_envs.unwrapped import scene_of

_ONE_TARGET = ("reach", "navigate")  # kinds that need no poses of other objects in the observation
_PREFERRED = ("pd_ee_delta_pos", "pd_joint_delta_pos")  # control modes, the first that a robot has is used


def env_kwargs(config: TrainConfig) -> dict[str, Any]:
    """Return the arguments of `simrecon_envs.make` without scene and registry."""
    kwargs: dict[str, Any] = {
        "task": config.task,
        "robot_uids": config.robot,
        "obs_mode": config.obs_mode,
        "control_mode": config.control_mode,
        "reward_mode": "normalized_dense",
        "randomize": config.randomize,
        "observe_objects": config.task.split("_")[0] not in _ONE_TARGET,
        "max_episode_steps": config.settings.horizon or episode_steps(config.task),
    }
    if config.obs_mode == "rgb":
        kwargs["sensor_configs"] = {"width": config.settings.image_px, "height": config.settings.image_px}
    return kwargs


def make_plain(config: TrainConfig, **more: Any) -> gym.Env:
    """Make one environment without training wrappers, for evaluation.

    Args:
        config: Of the run; `control_mode` is resolved.
        **more: More arguments of `simrecon_envs.make`.
    """
    return make_cpu(config.scene, registry=config.registry, **(env_kwargs(config) | more))


def make_one(config: TrainConfig) -> gym.Env:
    """Make one environment for training."""
    env = make_plain(config)
    if config.obs_mode != "state":
        env = FlatPictures(env)
    gamma = config.settings.gamma if config.settings.success_bonus else 0.0
    return EpisodeInfo(env, bonus=gamma / (1 - gamma))


def make_several(config: TrainConfig) -> Any:
    """Make the vector environment for training, without normalization; several environments have a process each."""
    from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

    makers = [in_worker(_make_one, config)] * config.envs
    if config.envs == 1:
        return DummyVecEnv(makers)
    # Ctrl-C reaches all processes of a terminal. Workers inherit SIG_IGN and leave it to the training process.
    before = signal.signal(signal.SIGINT, signal.SIG_IGN) if _is_main_thread() else None
    try:
        return SubprocVecEnv(makers, start_method=start_method())
    finally:
        if before is not None:
            signal.signal(signal.SIGINT, before)


def resolve(config: TrainConfig) -> tuple[TrainConfig, dict[str, Any]]:
    """Make the environment once to check a configuration and to resolve its defaults.

    Returns:
        The configuration with scene id, task name, control mode and registry path resolved, and facts of the scene:
        {"scene_id", "revision", "target_id", "instruction", "task_note"}.

    Raises:
        SceneNotFound, EnvNotFound, UsageError: the scene, task, robot or control mode do not exist.
        EnvironmentMissing: images are to be observed, and nothing can render here.
    """
    import dataclasses

    env = make_cpu(config.scene, registry=config.registry, **env_kwargs(config) | {"control_mode": None})
    try:
        scene = scene_of(env)
        if scene.task_object is None or scene.agent is None:
            raise UsageError(f"scene {scene.scene_id}: no task to train: {scene.task_note or config.task}")
        modes = list(scene.agent.supported_control_modes)
        mode = config.control_mode
        if mode == "auto":
            wanted = _PREFERRED[1:] if scene.task_kind == "navigate" else _PREFERRED
            mode = next((known for known in wanted if known in modes), modes[0])
        if mode not in modes:
            raise UsageError(f"--control-mode {mode}: {config.robot} has {', '.join(modes)}")
        known = {
            "scene_id": scene.scene_id,
            "revision": scene.bundle.revision,
            "target_id": scene.target_id,
            "instruction": scene.instruction,
            "task_note": scene.task_note,
        }
        registry = str(config.registry) if config.registry is not None else None
        return dataclasses.replace(
            config, scene=scene.scene_id, task=scene.task, control_mode=mode, registry=registry
        ), known
    finally:
        env.close()


class EpisodeInfo(gym.Wrapper):
    """Reports return, length and success at an episode's end, in the format of stable-baselines3.

    Adds a bonus to the reward at success. Success ends an episode, so without a bonus hovering near the goal would
    collect more dense reward. The bonus is the discounted reward of staying successful for ever.
    """

    def __init__(self, env: gym.Env, bonus: float = 0.0) -> None:
        """Wrap one environment; the reported return excludes `bonus`."""
        super().__init__(env)
        self._bonus = bonus
        self._return, self._length, self._began = 0.0, 0, time.time()

    def reset(self, **kwargs: Any) -> tuple[Any, dict]:
        """Begin an episode."""
        self._return, self._length, self._began = 0.0, 0, time.time()
        obs, info = self.env.reset(**kwargs)
        return obs, {"instruction": info.get("instruction", "")}

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict]:
        """Step; `info` is empty except at the last step: {"episode": {"r", "l", "t"}, "is_success"}."""
        obs, reward, terminated, truncated, info = self.env.step(action)
        reward = float(reward)
        self._return += reward
        self._length += 1
        success = bool(info.get("success", False))
        told: dict[str, Any] = {}
        if terminated or truncated:
            seconds = round(time.time() - self._began, 6)
            told = {"episode": {"r": self._return, "l": self._length, "t": seconds}, "is_success": success}
        return obs, reward + (self._bonus if success and terminated else 0.0), terminated, truncated, told


class FlatPictures(gym.ObservationWrapper):
    """Flattens image observations to {"state": (k,) float32, "CAMERA_rgb": (h, w, 3) uint8 ...}."""

    def __init__(self, env: gym.Env) -> None:
        """Wrap one environment with nested observations."""
        super().__init__(env)
        spaces: dict[str, gym.Space] = {}
        nested: Any = env.observation_space  # Dicts of Dicts of Boxes
        for name, sensor in nested["sensor_data"].items():
            spaces[f"{name}_rgb"] = gym.spaces.Box(0, 255, sensor["rgb"].shape, np.uint8)
        parts = [nested[key] for key in ("agent", "extra") if key in nested.spaces]
        size = sum(gym.spaces.flatdim(part) for part in parts)
        spaces["state"] = gym.spaces.Box(-np.inf, np.inf, (size,), np.float32)
        self.observation_space = gym.spaces.Dict(spaces)

    def observation(self, observation: dict) -> dict[str, np.ndarray]:
        """Flatten one observation."""
        return flat_pictures(observation)


def flat_pictures(observation: dict) -> dict[str, np.ndarray]:
    """Return an image observation in the format of `FlatPictures`."""
    flat = {f"{name}_rgb": np.asarray(of["rgb"]) for name, of in observation["sensor_data"].items()}
    leaves = [np.ravel(leaf) for key in ("agent", "extra") for leaf in _leaves(observation.get(key, {}))]
    flat["state"] = np.concatenate(leaves, dtype=np.float32, casting="unsafe")
    return flat


def _leaves(entry: Any) -> Any:
    if isinstance(entry, dict):
        for value in entry.values():
            yield from _leaves(value)
    else:
        yield entry


def _make_one(config: TrainConfig) -> gym.Env:
    import torch

    torch.set_num_threads(1)
    if multiprocessing.parent_process() is not None:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    return make_one(config)


def _is_main_thread() -> bool:
    import threading

    return threading.current_thread() is threading.main_thread()
