"""Add packed scenes to the registry and register them with Gymnasium, in one call."""

from pathlib import Path

from registry import open_registry
from simrecon_envs.registration import env_id, register_scenes


def add(
    source: Path | str, *, name: str | None = None, replace: bool = False, registry: Path | str | None = None
) -> str:
    """Verify a packed scene, add it to the registry, register it; a scene that is there already is left as it is.

        gym.make(simrecon_envs.add("room.simrecon"))

    Args:
        source: Output of `simrecon pack`: a file, a URL, or the folder of a bundle.
        name: Scene id in the registry; None for the scene's own.
        replace: Replace a scene that has this id and another revision.
        registry: Folder of the registry; None for the default one.

    Returns:
        The id for `gym.make`, such as "SimRecon/room".

    Raises:
        UsageError: There is no such source, or the id is taken by another revision.
        BundleError: The source is malformed, unsafe or damaged; the registry is as it was.
        EnvironmentMissing: A place cannot be reached, or a disk cannot be written.
    """
    from registry.exchange import add_scene

    catalog = open_registry(registry)
    added = add_scene(source, catalog, scene_id=name, replace=replace)
    register_scenes(registry)
    return env_id(added.scene_id)
