"""A physics engine without a past, for the bodies that an environment has.

PhysX keeps what touched what, and in which order it found out, from one episode to the next: a run after other runs
differs from a first one in its last digits, and soon altogether. All of that is the engine's; the bodies, their cooked
meshes and what a renderer knows of them are not, and go on as they are.
"""

from typing import Any

import sapien
from sapien import physx


def renew_physics(env: Any, entities: list[sapien.Entity] | None = None) -> None:
    """Move everything of a `SceneEnv` with one environment on the CPU to a new PhysX scene, in the order of before.

    Takes a millisecond or two. Entities keep their ids, poses and components; velocities and who sleeps are the
    caller's affair.

    Args:
        env: The environment.
        entities: All of its entities in their order, where some were taken out of the scene.
    """
    old = env.scene.sub_scenes[0]
    entities = list(old.entities) if entities is None else entities
    env._set_scene_config()  # a default of the process, which another environment may have changed
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
