"""`TrainedPolicy`: the policy of a training run, a function from observation to action."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from registry import UsageError
from simrecon_envs.training.config import TrainConfig
from simrecon_envs.training.environments import env_kwargs, flat_pictures
from simrecon_envs.training.folder import RunFolder, runs_root

# The part of env_kwargs that defines observations and actions; the rest defines the episode.
_INTERFACE = ("obs_mode", "control_mode", "observe_objects", "sensor_configs")


class TrainedPolicy:
    """The policy of a run. Call it, or `act`, with an observation of an environment made with `env_kwargs`.

    Attributes:
        folder: The run's folder.
        steps: Training steps of the checkpoint.
        config: The run's configuration.
    """

    def __init__(self, folder: Path | str, device: str = "cpu") -> None:
        """Load the newest checkpoint of a run.

        Raises:
            UsageError: the folder has no run, or no checkpoint yet.
        """
        from simrecon_envs.training.models import load_for_use

        run = RunFolder.open(folder)
        self.config = TrainConfig.from_json(run.read_config()["config"])
        checkpoints = run.checkpoints()
        if not checkpoints:
            raise UsageError(f"{folder}: the run has no checkpoint yet; train it first")
        self.folder, (self.steps, path) = run.path, checkpoints[-1]
        self._network, self._statistics = load_for_use(self.config.algo, path, device)
        self._network.set_training_mode(False)

    @property
    def env_kwargs(self) -> dict[str, Any]:
        """Return the arguments of `simrecon_envs.make(scene, **kwargs)` with which the policy was trained."""
        return env_kwargs(self.config)

    @property
    def observation_shape(self) -> tuple[int, ...] | None:
        """Return the shape of one observation; None for dicts."""
        return self._network.observation_space.shape

    def reset(self) -> None:
        """Begin an episode; the policy has no state."""

    def act(self, observation: Any) -> np.ndarray:
        """Return the deterministic action (k,), or (b, k) for a batch.

        Args:
            observation: Of the environment: a vector or a dict, NumPy or torch, batched or not.
        """
        observation = _numpy(observation)
        if isinstance(observation, dict) and "sensor_data" in observation:
            observation = flat_pictures(observation)
        if self._statistics.norm_obs:
            observation = self._statistics.normalize_obs(observation)
        return self._network.predict(observation, deterministic=True)[0]

    __call__ = act


def load_policy(run_dir: Path | str, device: str = "cpu") -> TrainedPolicy:
    """Return the policy of a training run: a function of observations.

    Args:
        run_dir: The run's folder. It contains pickles: load only folders that you trust.
        device: torch device.

    Raises:
        UsageError: the folder has no run, or no checkpoint yet.
    """
    return TrainedPolicy(run_dir, device)


def trained(env: Any, run: str | None = None) -> TrainedPolicy:
    """Return the policy that was trained for an environment, for `simrecon benchmark run`.

        simrecon benchmark run ... --policy simrecon_envs.training:trained --policy-option run=FOLDER

    Args:
        env: The environment to act in.
        run: The run's folder; the latest of the environment's scene, task and robot where None.

    Raises:
        UsageError: there is no such run, or the environment's robot, control mode or observations differ.
    """
    scene = env.unwrapped
    policy = TrainedPolicy(run or _newest(scene.scene_id, scene.task, scene.robot_uids).path)
    for what, ours, theirs in (
        ("robot", policy.config.robot, scene.robot_uids),
        ("control_mode", policy.config.control_mode, scene.agent.control_mode),
    ):
        if ours != theirs:
            raise UsageError(f"{policy.folder}: trained with {what}={ours!r}, the environment has {theirs!r}")
    shape = env.observation_space.shape
    if policy.config.obs_mode == "state" and (shape is None or shape[-1:] != policy.observation_shape):
        raise UsageError(
            f"{policy.folder}: trained for {policy.config.task} with observations {policy.observation_shape}, those "
            f"of {scene.scene_id}, {scene.task} are {shape}; choose a task of the same kind, or make the environment "
            f"with {options_of_run(policy.config)}"
        )
    return policy


def options_of_run(config: TrainConfig) -> dict[str, Any]:
    """Return the arguments of `gym.make` that define a run's observations and actions, for any task."""
    kwargs = env_kwargs(config)
    return {key: kwargs[key] for key in _INTERFACE if key in kwargs}


def _options(task: Any, run: str | None = None) -> dict[str, Any]:
    """Return the arguments of `gym.make` for `trained` on a suite's task."""
    folder = RunFolder.open(run) if run else _newest(task.scene, task.task, task.robot)
    return options_of_run(TrainConfig.from_json(folder.read_config()["config"]))


def _warning(run: str | None = None) -> str:
    """Return what a user of `trained` should know."""
    return (
        f"{run or 'the policy'} is loaded with pickle, which can run any code on this machine; use only runs of your "
        "own or of people whom you trust"
    )


trained.policy_options = _options
trained.policy_warning = _warning


def _newest(scene: str, task: str, robot: str) -> RunFolder:
    folder = RunFolder.newest(scene, task, usable=True, robot=robot)
    if folder is None:
        raise UsageError(
            f"no run of scene {scene}, task {task}, robot {robot} in {runs_root()}: train one with "
            f"`simrecon train {scene} --task {task} --robot {robot}`"
        )
    return folder


def _numpy(value: Any) -> Any:
    """Convert tensors to NumPy arrays of the same shape."""
    if isinstance(value, Mapping):
        return {key: _numpy(part) for key, part in value.items()}
    return value.cpu().numpy() if hasattr(value, "cpu") else np.asarray(value)
