"""Stage 8: assets -> scene graph. Every object gets exactly one parent; floor and walls are the roots.

Regions by clustering, relations per region from a backend (geometry by default), merged into one graph with
conflict resolution, as the paper's Scene Graph Synthesizer does.
"""

from dataclasses import dataclass, field
from typing import Literal

from reconstruction.progress import NO_PROGRESS, Progress
from reconstruction.scene_graph.merge import GraphMerge, breadth_first
from reconstruction.scene_graph.regions import find_regions
from reconstruction.scene_graph.relations import GeometryRelations, RelationBackend, RelationConfig
from reconstruction.types import AssetSet, Edge, SceneGraph
from registry.errors import InputError

VERSION = 1


@dataclass(frozen=True)
class SceneGraphConfig:
    """How relations are inferred and merged."""

    strategy: Literal["regions", "naive", "global"] = "regions"
    """The paper's method; without conflict resolution; or one question about everything."""
    region_radius_m: float = 0.5
    """DBSCAN: objects whose centers are this close belong together."""
    region_min_objects: int = 2
    """DBSCAN: an object with this many in its radius (itself included) is a core."""
    view_margin_m: float = 0.25
    """How far around a region its view shows other objects."""
    relations: RelationConfig = field(default_factory=RelationConfig)
    """Tolerances of the geometric backend."""


SCENE_GRAPH_PRESETS = {
    "fast": SceneGraphConfig(),
    "default": SceneGraphConfig(),
    "quality": SceneGraphConfig(),
}


def infer_scene_graph(
    assets: AssetSet,
    config: SceneGraphConfig,
    *,
    backend: RelationBackend | None = None,
    progress: Progress = NO_PROGRESS,
) -> SceneGraph:
    """Find the parent of every object: what carries it, or what it hangs on.

    Raises:
        InputError: the assets hold no floor, so the graph has no root.
    """
    base_ids = [b.id for b in assets.base]
    if not any(b.label == "floor" for b in assets.base):
        raise InputError(
            f"scene graph: none of the {len(base_ids)} base surfaces is a floor, so nothing can stand; "
            "the instance stage must find or assume one"
        )
    backend = backend or GeometryRelations(assets, config.relations)
    everything = tuple(sorted(o.id for o in assets.objects))
    if config.strategy == "global":
        views = [everything]
    else:
        regions = find_regions(
            assets.objects, config.region_radius_m, config.region_min_objects, config.view_margin_m
        )
        views = [visible for _, visible in regions]
    progress.start(len(views), "relations")
    graphs = []
    for view in views:
        graphs.append(backend.infer(view))
        progress.advance()
    edges = merge_graphs(
        graphs, base_ids, everything, backend, naive=config.strategy == "naive", progress=progress
    )
    return SceneGraph(edges)


def merge_graphs(
    graphs: list[list[Edge]],
    base_ids: list[int],
    object_ids: tuple[int, ...],
    backend: RelationBackend,
    *,
    naive: bool = False,
    progress: Progress = NO_PROGRESS,
) -> tuple[Edge, ...]:
    """Merge the regions' graphs; the result does not depend on their order."""
    merge = GraphMerge(base_ids, None if naive else backend)
    # A canonical order makes the outcome independent of the order in which regions arrive.
    for graph in sorted(graphs, key=lambda edges: sorted((e.child, e.parent, e.relation) for e in edges)):
        merge.add_graph(graph)
    for line in merge.conflicts:
        progress.note(f"scene graph: {line}")
    missing = [i for i in object_ids if i not in merge.parent_edge]
    if missing:
        progress.note(
            f"scene graph: no region connects {missing} to the base; asked again with everything in view"
        )
        merge.add_graph(
            [e for e in backend.infer(object_ids) if e.child in set(missing)] + list(merge_edges(merge))
        )
    for i in object_ids:
        if i not in merge.parent_edge:
            root = min(base_ids)
            progress.note(f"scene graph: object {i} has no path to the base; put on base {root}")
            merge.parent_edge[i] = Edge(i, "supported_by", root, 0.05, "no relation was found")
    return merge_edges(merge)


def merge_edges(merge: GraphMerge) -> tuple[Edge, ...]:
    """Return the merged edges, breadth first from the base."""
    return tuple(breadth_first(list(merge.parent_edge.values()), merge.base_ids))


__all__ = ["SCENE_GRAPH_PRESETS", "VERSION", "SceneGraphConfig", "infer_scene_graph", "merge_graphs"]
