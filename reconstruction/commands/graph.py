"""`simrecon show SCENE --graph`: draws the steps of the scene graph's merge."""

import argparse
import json
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from reconstruction.commands.options import output_errors
from reconstruction.measure.report.graph_sheet import write_graph_steps
from reconstruction.measure.stage_results import StageResults
from registry import SceneBundle
from registry.errors import UsageError

_STAGES = ("world", "gaussians", "surface", "instances", "assets", "poses")


def show_graph(arguments: argparse.Namespace, bundle: SceneBundle, registry_root: Path) -> int:
    """Write a picture of every merge step, and print the edges with their sources."""
    graph = bundle.scene["graph"]
    if "steps" not in graph:
        raise UsageError(
            f"{arguments.scene}: its bundle does not hold the steps of its graph, as it is of an earlier version; "
            f"reconstruct it again"
        )
    names = {item["id"]: item["label"] for item in (*bundle.scene["base"], *bundle.scene["objects"])}
    results = StageResults.find(bundle, registry_root, arguments.work_dir)
    views, missing = step_views(bundle, results)
    if missing:
        print(f"only graphs are drawn, without views: {missing}", file=sys.stderr)
    folder = arguments.out or Path(f"{arguments.scene}_graph")
    with output_errors(folder):
        files = write_graph_steps(graph["steps"], names, views, folder)
    if arguments.json:
        print(json.dumps({"edges": graph["edges"], "files": [str(f) for f in files]}, indent=2))
        return 0
    for edge in sorted(graph["edges"], key=lambda e: e["child"]):
        relation = f"{edge['relation'].replace('_', ' ')} {edge['parent']} {names[edge['parent']]}"
        print(
            f"{edge['child']:4d}  {names[edge['child']]:<18} {relation:<36} {edge['confidence']:.2f}  "
            f"{edge['said_by']}: {edge['evidence']}"
        )
    print(f"steps: {folder} ({len(files)} pictures)")
    return 0


def step_views(bundle: SceneBundle, results: StageResults) -> tuple[list[np.ndarray | None], str]:
    """Return a view for each merge step, and the reason if some are missing.

    Args:
        bundle: the scene; it holds the pictures that a model was shown.
        results: stage cache of the scene; the other views are rendered from it.

    Returns:
        Views uint8 (h, w, 3) RGB, None where there is none, and the reason ("" if none is missing).
    """
    from reconstruction.scene_graph import Question, SceneGraphConfig
    from reconstruction.scene_graph.looking import RegionViewer
    from reconstruction.views import ViewScene, prepare_scene

    steps = bundle.scene["graph"]["steps"]
    kept = [_kept_picture(bundle, step) for step in steps]
    wanted = [k for k, step in enumerate(steps) if kept[k] is None and step["kind"] != "fallback"]
    if not wanted:
        return kept, ""
    gone = next((name for name in _STAGES if results.get(name) is None), None)
    if gone is not None:
        return kept, f"views need the stage {gone}, but {results.missing[gone]}"
    done: dict[str, Any] = {name: results.get(name) for name in _STAGES}

    def make_scene() -> ViewScene:
        gaussians = done["gaussians"].in_world(done["world"])
        return prepare_scene(gaussians, done["surface"], done["instances"], done["poses"].camera)

    config = SceneGraphConfig()
    viewer = RegionViewer(done["assets"], make_scene, config.picture_side_px, config.least_visible)
    looked_at: Counter[tuple[int, ...]] = Counter()
    for k, step in enumerate(steps):
        about = tuple(step["about"])
        if k in wanted:
            view = viewer.look(Question.of(about, step["visible"], looked_at[about]))
            kept[k] = None if view is None else view.picture
        looked_at[about] += 1
    return kept, ""


def _kept_picture(bundle: SceneBundle, step: dict) -> np.ndarray | None:
    if "picture" not in step:
        return None
    image = cv2.imread(str(bundle.root / step["picture"]))
    return None if image is None else cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
