"""The environment inside Gymnasium's wrappers."""

from typing import TYPE_CHECKING, cast

import gymnasium as gym

if TYPE_CHECKING:
    from simrecon_envs.scene_env import SceneEnv


def scene_of(env: gym.Env) -> "SceneEnv":
    """Return the `SceneEnv` inside wrappers."""
    return cast("SceneEnv", env.unwrapped)
