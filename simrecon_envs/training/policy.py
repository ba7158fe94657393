"""What was trained, as a policy: observation -> action."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from registry import UsageError
from simrecon_envs.training.config import TrainConfig
from simrecon_envs.training.environments import env_kwargs, flat_pictures
from simrecon_envs.training.folder import RunFolder, runs_root


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
    if run is None:
        wanted = (scene.scene_id, scene.task, scene.robot_uids)
        found = [path for path in runs_root().glob("*") if _made_for(path) == wanted]
        if not found:
            raise UsageError(
                f"no run of scene {wanted[0]}, task {wanted[1]}, robot {wanted[2]} in {runs_root()}: train one with "
                f"`simrecon train {wanted[0]} --task {wanted[1]}`"
            )
        run = str(max(found, key=lambda path: (path / "config.json").stat().st_mtime))
    policy = TrainedPolicy(run)
    mode, ours = scene.agent.control_mode, policy.config.control_mode
    if mode != ours:
        raise UsageError(f"{policy.folder}: trained with control_mode={ours!r}, the environment has {mode!r}")
    size = env.observation_space.shape
    if policy.config.obs_mode == "state" and size[-1:] != policy.observation_shape:
        raise UsageError(
            f"{policy.folder}: trained with observations {policy.observation_shape}, the environment's are {size}; "
            f"make it with {policy.env_kwargs}"
        )
    return policy


# What `simrecon train --task reach` trains with, for whoever makes the environment.
trained.policy_options = {"control_mode": "pd_ee_delta_pos", "observe_objects": False}


def _made_for(path: Path) -> tuple[str, str, str] | None:
    try:
        config = json.loads((path / "config.json").read_text(encoding="utf-8"))["config"]
        whole = any((path / "checkpoints").glob("step_*"))
        return (config["scene"], config["task"], config["robot"]) if whole else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _numpy(value: Any) -> Any:
    """Return tensors as NumPy's; a batch of one environment stays a batch."""
    if isinstance(value, Mapping):
        return {key: _numpy(part) for key, part in value.items()}
    return value.cpu().numpy() if hasattr(value, "cpu") else np.asarray(value)
