"""What was trained, as a policy: observation -> action."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from registry import UsageError
from simrecon_envs.training.config import TrainConfig
from simrecon_envs.training.environments import env_kwargs, flat_pictures
from simrecon_envs.training.folder import RunFolder, runs_root

_HOW = (
    "obs_mode",
    "control_mode",
    "observe_objects",
    "sensor_configs",
)  # of env_kwargs: the rest makes the episode


class TrainedPolicy:
    """The policy of a run. Call it, or `act`, with an observation of an environment made with `env_kwargs`.

    Attributes:
        folder: The run's.
        steps: After how many steps of training.
        config: The run's.
    """

    def __init__(self, folder: Path | str, device: str = "cpu") -> None:
        """Load the newest checkpoint of a run.

        Raises:
            UsageError: there is no run in the folder, or no checkpoint yet.
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
        """Return what `simrecon_envs.make(scene, **kwargs)` needs for an environment of this policy."""
        return env_kwargs(self.config)

    @property
    def observation_shape(self) -> tuple[int, ...] | None:
        """Return the shape of one observation; None where it is a dict."""
        return self._network.observation_space.shape

    def reset(self) -> None:
        """Begin an episode; the policy remembers nothing."""

    def act(self, observation: Any) -> np.ndarray:
        """Return the action (k,), or (b, k) for a batch, without noise.

        Args:
            observation: As the environment gives it: a vector or a dict, NumPy or torch, batched or not.
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
        run_dir: The run's folder. It holds pickles: load only what you trained or trust.
        device: Where to compute.

    Raises:
        UsageError: there is no run in the folder, or no checkpoint yet.
    """
    return TrainedPolicy(run_dir, device)


def trained(env: Any, run: str | None = None) -> TrainedPolicy:
    """Return the policy that was trained for an environment, for `simrecon benchmark run`:

        simrecon benchmark run ... --policy simrecon_envs.training:trained --policy-option run=FOLDER

    Args:
        env: What it shall act in.
        run: The run's folder; the newest of the environment's scene, task and robot where None.

    Raises:
        UsageError: no run fits, or the environment was made in another way than the one it was trained in.
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
    """Return how an environment observes and acts in which a run's policy can be used, whatever the task."""
    kwargs = env_kwargs(config)
    return {key: kwargs[key] for key in _HOW if key in kwargs}


def _options(task: Any, run: str | None = None) -> dict[str, Any]:
    """Return what `trained` needs of `gym.make` for a suite's task."""
    folder = RunFolder.open(run) if run else _newest(task.scene, task.task, task.robot)
    return options_of_run(TrainConfig.from_json(folder.read_config()["config"]))


trained.policy_options = _options


def _newest(scene: str, task: str, robot: str) -> RunFolder:
    folder = RunFolder.newest(scene, task, usable=True, robot=robot)
    if folder is None:
        raise UsageError(
            f"no run of scene {scene}, task {task}, robot {robot} in {runs_root()}: train one with "
            f"`simrecon train {scene} --task {task} --robot {robot}`"
        )
    return folder


def _numpy(value: Any) -> Any:
    """Return tensors as NumPy's; a batch of one environment stays a batch."""
    if isinstance(value, Mapping):
        return {key: _numpy(part) for key, part in value.items()}
    return value.cpu().numpy() if hasattr(value, "cpu") else np.asarray(value)
