"""Move the bodies of an environment to a fresh PhysX scene, for reproducible episodes.

PhysX keeps contact pairs and their order across episodes, so a later episode differs from a first one in the last
digits, and soon visibly. This state belongs to the PhysX scene. Bodies, cooked meshes and render data are reused.
"""

from typing import Any

import sapien
from sapien import physx


def renew_physics(env: Any, entities: list[sapien.Entity] | None = None) -> None:
    """Move all entities of a `SceneEnv` to a new PhysX scene, in order (1 to 2 ms).

    Entities keep their ids, poses and components. The caller sets velocities and sleep states.

    Args:
        env: One environment on the CPU.
        entities: All of its entities in order, if some were removed from the scene; else None.
    """
    old = env.scene.sub_scenes[0]
    entities = list(old.entities) if entities is None else entities
    env._set_scene_config()  # process-wide; another environment may have changed it
    engine = physx.PhysxCpuSystem()
    engine.timestep = env.scene.px.timestep
    renders = env.scene.can_render()
    new = sapien.Scene([engine, old.render_system] if renders else [engine])
    for entity in list(old.entities):
        entity.remove_from_scene()
    for entity in entities:
        entity.add_to_scene(new)
    if renders:
        new.ambient_light = old.ambient_light
    env.scene.sub_scenes[0], env.scene.px = new, engine
    if env._viewer is not None:
        env._viewer.set_scene(new)
