"""The entry point of registered environments: `SceneEnv`, imported without garbage collection."""

from simrecon_envs.collection import without_collection

with without_collection():
    from simrecon_envs.scene_env import SceneEnv

__all__ = ["SceneEnv"]
