"""A stage's result and the user's corrections in, the corrected result out."""

from collections.abc import Mapping
from typing import Any

from reconstruction.assembly import assemble
from reconstruction.core.progress import Progress
from reconstruction.editing.anchors import Pointer
from reconstruction.editing.overrides import Overrides


def corrected(
    stage: str,
    plain: Any,
    results: Mapping[str, Any],
    options: Any,
    overrides: Overrides,
    pointer: Pointer,
    progress: Progress,
) -> Any:
    """Return a stage's result as the user's entries correct it.

    Args:
        stage: its name, a key of `overrides.ACTIONS`.
        plain: the result without corrections.
        results: of the stages that it reads.
        options: of the stage.
        overrides: the user's entries.
        pointer: what their addresses are looked up in.
        progress: told of decisions.

    Raises:
        UsageError: an entry names what is not there, or asks for what cannot be.
    """
    if stage == "instances":
        return overrides.apply_to_instances(pointer)
    if stage == "assets":
        return overrides.apply_to_assets(plain, pointer)
    if stage == "scene_graph":
        return overrides.apply_to_graph(plain, results["assets"], pointer)
    assets, graph = results["assets"], results["scene_graph"].plain()
    movable = overrides.movable(assets, graph, pointer)
    return assemble(assets, graph, options, movable=movable, progress=progress)
