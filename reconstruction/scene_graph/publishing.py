"""Write the graph into a bundle: edges with their sources, steps of merging, pictures that models were shown."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import cv2

from reconstruction.core.types import Edge
from reconstruction.scene_graph.base import MergedGraph, MergeStep, SaidEdge

FOLDER = "graph"


def graph_of_bundle(final: Sequence[Edge], graph: MergedGraph, folder: Path) -> dict:
    """Write pictures into a bundle's folder; return the `graph` of its JSON.

    Args:
        final: edges after assembly, which may change parents.
        graph: merged, and perhaps corrected by the user.
        folder: the bundle.
    """
    before = {edge.child: edge for edge in graph.edges}
    edges = [asdict(edge) | {"said_by": _said_by(edge, before.get(edge.child))} for edge in final]
    return {"edges": edges, "steps": [_step(n, step, folder) for n, step in enumerate(graph.steps)]}


def _said_by(edge: Edge, before: SaidEdge | None) -> str:
    if edge.evidence == "user":
        return "user"
    if before is None or (before.relation, before.parent) != (edge.relation, edge.parent):
        return "assembly"
    return before.said_by


def _step(number: int, step: MergeStep, folder: Path) -> dict:
    out = {
        "kind": step.kind,
        "about": list(step.about),
        "visible": list(step.visible),
        "said": [_triple(e) | {"said_by": e.said_by} for e in step.said],
        "decisions": [asdict(d) for d in step.decisions],
        "merged": [_triple(e) for e in step.merged],
        "notes": list(step.notes),
    }
    if step.picture is not None:
        out["picture"] = f"{FOLDER}/step_{number:03d}.jpg"
        (folder / FOLDER).mkdir(exist_ok=True)
        bgr = cv2.cvtColor(step.picture, cv2.COLOR_RGB2BGR)
        cv2.imwrite(str(folder / out["picture"]), bgr, [cv2.IMWRITE_JPEG_QUALITY, 90])
    return out


def _triple(edge: SaidEdge) -> dict:
    return {"child": edge.child, "relation": edge.relation, "parent": edge.parent}
