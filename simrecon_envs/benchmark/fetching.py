"""Pull the scenes of a suite that a registry lacks, by their revisions, from a shared place (docs/sharing.md)."""

import os
from collections.abc import Iterable
from pathlib import Path

from registry import SceneNotFound, UsageError, open_registry
from simrecon_envs.benchmark.reporting import Reporter
from simrecon_envs.benchmark.suite import SuiteTask

PLACE_VARIABLE = "SIMRECON_SCENES_FROM"


def default_place() -> str | None:
    """Return the place that `$SIMRECON_SCENES_FROM` names, or None."""
    return os.environ.get(PLACE_VARIABLE) or None


def wanted_scenes(tasks: Iterable[SuiteTask]) -> dict[str, str]:
    """Return {scene id: revision} of some tasks."""
    return {task.scene: task.revision for task in tasks}


def fetch_scenes(
    tasks: Iterable[SuiteTask], place: str | Path, registry: Path | str | None, reporter: Reporter
) -> list[str]:
    """Pull the scenes that are not in a registry; scenes that are there stay, also with another revision.

    Args:
        tasks: Tasks of a suite.
        place: A folder or an fsspec address.
        registry: Folder of the registry; None for the default one.
        reporter: Receives a line for each scene.

    Returns:
        The pulled scenes, `SCENE@REVISION`.

    Raises:
        UsageError: The place has not all of them; names each.
        EnvironmentMissing: The place cannot be reached, or the registry cannot be written.
    """
    from registry.exchange import open_place, pull_scene

    catalog = open_registry(registry)
    known = catalog.revisions()
    missing = [
        f"{scene}@{revision}" for scene, revision in wanted_scenes(tasks).items() if scene not in known
    ]
    if not missing:
        return []
    opened = open_place(place)
    failed: list[str] = []
    for name in missing:
        try:
            pull_scene(opened, name, catalog)
            reporter.note(f"pulled {name} from {opened.url}")
        except (SceneNotFound, UsageError) as error:
            failed.append(str(error))
    if failed:
        raise UsageError(
            f"{len(failed)} of {len(missing)} missing scenes could not be pulled: {'; '.join(failed)}"
        )
    return missing


def how_to_get(wanted: dict[str, str], replace: bool) -> str:
    """Return the commands that bring scenes with these revisions into a registry."""
    names = " ".join(f"{scene}@{revision}" for scene, revision in wanted.items())
    pull = f"`simrecon pull PLACE {names}{' --replace' if replace else ''}`"
    if replace:
        return f"get the suite's with {pull}, which replaces yours, or into another registry with --registry"
    return f"get them from who made the suite: {pull}, or --fetch-from PLACE, or ${PLACE_VARIABLE}"
