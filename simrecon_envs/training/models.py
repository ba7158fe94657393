"""Build stable-baselines3 algorithms from a configuration; save and load checkpoints."""

import pickle
import random
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from registry import EnvironmentMissing, UsageError
from simrecon_envs.training.config import PpoSettings, SacSettings, TrainConfig

_CLASSES: dict[str, type[BaseAlgorithm]] = {"ppo": PPO, "sac": SAC}


def check_device(device: str) -> None:
    """Check that torch can use a device ("cpu", "cuda", "cuda:1" …).

    Raises:
        UsageError: it is not a CPU or CUDA device.
        EnvironmentMissing: this machine has no CUDA.
    """
    try:
        kind = torch.device(device).type
    except RuntimeError as error:
        raise UsageError(f"--device {device}: expected cpu or cuda ({error})") from error
    if kind not in ("cpu", "cuda"):
        raise UsageError(f"--device {device}: expected cpu or cuda")
    if kind == "cuda" and not torch.cuda.is_available():
        raise EnvironmentMissing(
            f"--device {device}: torch {torch.__version__} finds no CUDA here; use --device cpu"
        )


def normalized(config: TrainConfig, vec: VecEnv) -> VecNormalize:
    """Wrap environments with new running normalization statistics."""
    settings = config.settings
    keys = ["state"] if config.obs_mode != "state" else None
    return VecNormalize(
        vec,
        norm_obs=settings.normalize_observations,
        norm_reward=settings.normalize_rewards,
        gamma=settings.gamma,
        norm_obs_keys=keys if settings.normalize_observations else None,
    )


def build(config: TrainConfig, vec: VecEnv) -> BaseAlgorithm:
    """Build the algorithm of a new run."""
    settings = config.settings
    policy = "MlpPolicy" if config.obs_mode == "state" else "MultiInputPolicy"
    common: dict[str, Any] = {
        "learning_rate": settings.learning_rate,
        "gamma": settings.gamma,
        "batch_size": settings.batch_size,
        "seed": config.seed,
        "device": config.device,
    }
    shape: dict[str, Any] = {"net_arch": list(settings.net_arch)}
    if isinstance(settings, PpoSettings):
        with warnings.catch_warnings():  # an epoch's last batch may be smaller
            warnings.filterwarnings("ignore", message="You have specified a mini-batch size")
            return PPO(
                policy,
                vec,
                n_steps=config.block // config.envs,
                n_epochs=settings.n_epochs,
                gae_lambda=settings.gae_lambda,
                clip_range=settings.clip_range,
                ent_coef=settings.ent_coef,
                vf_coef=settings.vf_coef,
                max_grad_norm=settings.max_grad_norm,
                target_kl=settings.target_kl or None,
                policy_kwargs=shape | {"log_std_init": settings.log_std_init},
                **common,
            )
    assert isinstance(settings, SacSettings)
    return SAC(
        policy,
        vec,
        buffer_size=settings.buffer_size,
        learning_starts=settings.learning_starts,
        gradient_steps=settings.gradient_steps,
        tau=settings.tau,
        policy_kwargs=shape,
        **common,
    )


def save(model: BaseAlgorithm, folder: Path) -> None:
    """Write a checkpoint: weights, optimizers, normalization statistics, random states, SAC's replay buffer."""
    model.save(folder / "model.zip")
    statistics = model.get_vec_normalize_env()
    assert statistics is not None  # see `normalized`
    statistics.save(str(folder / "normalization.pkl"))
    if isinstance(model, SAC):
        model.save_replay_buffer(folder / "replay.pkl")
    states = {"torch": torch.get_rng_state(), "numpy": np.random.get_state(), "python": random.getstate()}
    if torch.cuda.is_available():
        states["cuda"] = torch.cuda.get_rng_state_all()
    (folder / "random.pkl").write_bytes(pickle.dumps(states))


def load(config: TrainConfig, folder: Path, vec: VecEnv) -> BaseAlgorithm:
    """Load a checkpoint to resume training in new environments; episodes start anew.

    Raises:
        UsageError: the checkpoint does not fit the environments, or is damaged.
    """
    try:
        vec = VecNormalize.load(str(folder / "normalization.pkl"), vec)
        model = _CLASSES[config.algo].load(folder / "model.zip", env=vec, device=config.device)
        if isinstance(model, SAC):
            model.load_replay_buffer(folder / "replay.pkl")
        states = pickle.loads((folder / "random.pkl").read_bytes())
    except (OSError, ValueError, KeyError, AssertionError, EOFError, pickle.UnpicklingError) as error:
        raise UsageError(
            f"{folder}: the checkpoint cannot be read ({error}); remove it to use the one before"
        ) from error
    torch.set_rng_state(states["torch"])
    np.random.set_state(states["numpy"])
    random.setstate(states["python"])
    if "cuda" in states and torch.cuda.is_available():
        torch.cuda.set_rng_state_all(states["cuda"])
    # A seed that depends on the step, so that the first episodes are not repeated.
    vec.seed((config.seed + 7919 * (model.num_timesteps + 1)) % 2**31)
    return model


def load_for_use(algo: str, folder: Path, device: str = "cpu") -> tuple[Any, VecNormalize]:
    """Return a checkpoint's policy network and normalization statistics, for inference."""
    statistics: VecNormalize = pickle.loads((folder / "normalization.pkl").read_bytes())
    statistics.training = False
    return _CLASSES[algo].load(folder / "model.zip", device=device).policy, statistics
