"""Train policies in reconstructed scenes with stable-baselines3, and load them.

`simrecon train SCENE --task reach` calls `train(TrainConfig(...))`, which writes a run folder. `load_policy(folder)`
returns the policy as a function of observations. `simrecon benchmark run --policy simrecon_envs.training:trained`
evaluates it.

torch and stable-baselines3 are imported on first use.
"""

from typing import TYPE_CHECKING, Any

from simrecon_envs.training.config import ALGORITHMS, PpoSettings, SacSettings, TrainConfig
from simrecon_envs.training.folder import RunFolder, runs_root

if TYPE_CHECKING:
    from simrecon_envs.training.policy import TrainedPolicy, load_policy, trained
    from simrecon_envs.training.run import train

__all__ = [
    "ALGORITHMS",
    "PpoSettings",
    "RunFolder",
    "SacSettings",
    "TrainConfig",
    "TrainedPolicy",
    "load_policy",
    "runs_root",
    "train",
    "trained",
]

_LAZY = {"TrainedPolicy": "policy", "load_policy": "policy", "trained": "policy", "train": "run"}


def __getattr__(name: str) -> Any:
    """Import modules that need torch on first use."""
    if name not in _LAZY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    import importlib

    return getattr(importlib.import_module(f"simrecon_envs.training.{_LAZY[name]}"), name)
