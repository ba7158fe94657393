"""Gymnasium environments of reconstructed scenes.

Importing this package registers every scene of the default registry as `SimRecon/<scene id>`; it reads only the
registry's index:

    import gymnasium as gym, simrecon_envs
    env = gym.make("SimRecon/scene0001")         # batched torch tensors, as in ManiSkill
    env = gym.make("SimRecon/scene0001-pick_mug-v0")          # a task from `list_tasks("scene0001")`
    env = gym.make(simrecon_envs.add("room.simrecon"))        # a scene from elsewhere, verified first
    env = simrecon_envs.make_cpu("scene0001")    # unbatched NumPy, e.g. for stable-baselines3

torch, sapien and mani_skill are loaded by the first `make`.
"""

from typing import TYPE_CHECKING, Any

from simrecon_envs.adding import add
from simrecon_envs.catalog import TaskEntry, list_scenes, list_tasks
from simrecon_envs.errors import EnvNotFound, SceneAssetsMissing
from simrecon_envs.registration import (
    answer_running_look_up,
    env_id,
    make,
    make_cpu,
    register_default_scenes,
    register_scenes,
    teach_gymnasium,
)
from simrecon_envs.vector import make_vec

if TYPE_CHECKING:
    from simrecon_envs.oracle import Oracle
    from simrecon_envs.randomization import Randomization
    from simrecon_envs.rollout import record_rollout, render_scene_picture
    from simrecon_envs.scene_env import SceneEnv

__all__ = [
    "EnvNotFound",
    "Oracle",
    "Randomization",
    "SceneAssetsMissing",
    "SceneEnv",
    "TaskEntry",
    "add",
    "env_id",
    "list_scenes",
    "list_tasks",
    "make",
    "make_cpu",
    "make_vec",
    "record_rollout",
    "register_scenes",
    "render_scene_picture",
]

_LAZY = {
    "Randomization": "simrecon_envs.randomization",
    "Oracle": "simrecon_envs.oracle",
    "SceneEnv": "simrecon_envs.entry",
    "record_rollout": "simrecon_envs.rollout",
    "render_scene_picture": "simrecon_envs.rollout",
}


def __getattr__(name: str) -> Any:
    """Import names that need the simulator on first use."""
    if name not in _LAZY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    import importlib

    return getattr(importlib.import_module(_LAZY[name]), name)


teach_gymnasium()
register_default_scenes()
answer_running_look_up()
