"""Apply the user's corrections to the result of a stage."""

from collections.abc import Mapping
from typing import Any

from reconstruction.assembly import assemble
from reconstruction.core.progress import Progress
from reconstruction.editing.anchors import Pointer
from reconstruction.editing.overrides import Overrides


def corrected(
    stage: str, plain: Any, results: Mapping[str, Any], options: Any, overrides: Overrides, pointer: Pointer,
    progress: Progress,
) -> Any:  # fmt: skip
    """Return the result of a stage with the user's corrections.

    Args:
        stage: name of the stage, a key of `entries.ACTIONS` after `world` (see `world_frame.corrected_world`).
        plain: its result without corrections.
        results: results of the stages that it reads.
        options: its config.
        overrides: the corrections.
        pointer: resolves their addresses.
        progress: receives notes.

    Raises:
        UsageError: an entry addresses a missing object, or its change is impossible.
    """
    if stage == "instances":
        return overrides.apply_to_instances(pointer)
    if stage == "assets":
        return overrides.apply_to_assets(plain, pointer, progress)
    if stage == "scene_graph":
        return overrides.apply_to_graph(plain, results["assets"], pointer)
    assets, graph = results["assets"], results["scene_graph"].plain()
    movable = overrides.movable(assets, graph, pointer)
    return assemble(assets, graph, options, movable=movable, progress=progress)
