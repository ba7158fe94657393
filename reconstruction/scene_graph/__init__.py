"""Stage 9, scene graph: assets in, one parent per object out; floor, walls and ceiling are the roots.

Objects are clustered into regions. A backend infers the relations of each region: from geometry, or by a
vision-language model that sees a view of it. Conflicts are resolved while merging: the paper's Scene Graph Synthesizer.
"""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from reconstruction.core.progress import NO_PROGRESS, Progress
from reconstruction.core.types import AssetSet
from reconstruction.scene_graph.base import (
    LocalGraph,
    MergedGraph,
    MergeStep,
    Question,
    RelationBackend,
    SaidEdge,
)
from reconstruction.scene_graph.config import SCENE_GRAPH_PRESETS, SceneGraphConfig
from reconstruction.scene_graph.load import RECORDS, backend_name, load_relations, outside_inputs, wants_views
from reconstruction.scene_graph.regions import find_regions
from reconstruction.scene_graph.relations import GeometryRelations
from reconstruction.scene_graph.synthesis import synthesize
from registry.errors import InputError

if TYPE_CHECKING:
    from reconstruction.views import ViewScene


def infer_scene_graph(
    assets: AssetSet,
    config: SceneGraphConfig,
    *,
    backend: RelationBackend | None = None,
    make_scene: "Callable[[], ViewScene] | None" = None,
    records: Path | None = None,
    progress: Progress = NO_PROGRESS,
) -> MergedGraph:
    """Infer the parent of every object: its support, or what it is attached to.

    Args:
        assets: base surfaces, the structure, and objects.
        config: settings.
        backend: overrides the one that the config names.
        make_scene: makes the Gaussians to render; called only by backends that use views.
        records: folder of recorded exchanges with a model.
        progress: receives steps and notes.

    Raises:
        InputError: there is no floor, so the graph has no root.
        EnvironmentMissing: something that the backend needs is missing.
    """
    base_ids = sorted(assets.static_labels, key=lambda i: (assets.static_labels[i] != "floor", i))
    if not any(b.label == "floor" for b in assets.base):
        raise InputError(
            f"scene graph: none of the {len(base_ids)} base surfaces is a floor, so nothing can stand; "
            "the instance stage must find or assume one"
        )
    backend = backend or load_relations(config, assets, make_scene, records)
    return synthesize(
        region_questions(assets, config),
        base_ids,
        sorted(o.id for o in assets.objects),
        backend,
        merging=config.merging,
        adjudications=config.adjudications,
        last_resort=lambda: GeometryRelations(assets, config.relations),
        progress=progress,
    )


def region_questions(assets: AssetSet, config: SceneGraphConfig) -> list[Question]:
    """Return one question per region."""
    radius_m, least, margin_m = config.region_radius_m, config.region_min_objects, config.view_margin_m
    regions = find_regions(assets.objects, radius_m, least, margin_m)
    return [Question.of(members, visible) for members, visible in regions]


__all__ = [
    "RECORDS",
    "SCENE_GRAPH_PRESETS",
    "GeometryRelations",
    "LocalGraph",
    "MergeStep",
    "MergedGraph",
    "Question",
    "RelationBackend",
    "SaidEdge",
    "SceneGraphConfig",
    "backend_name",
    "infer_scene_graph",
    "outside_inputs",
    "region_questions",
    "synthesize",
    "wants_views",
]
