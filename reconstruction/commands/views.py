"""`simrecon show SCENE --views`: writes contact sheets of the views of every object, made from the stage cache."""

import argparse
import json
from dataclasses import replace
from pathlib import Path

from reconstruction.cache import StageStore
from reconstruction.commands.options import output_errors
from reconstruction.commands.reporting import make_listener
from reconstruction.config import PipelineConfig
from reconstruction.measure.report.view_sheet import write_view_sheets
from reconstruction.measure.stage_results import StageResults
from reconstruction.pipeline import STAGES
from reconstruction.runner import Run
from reconstruction.views import AvoConfig, SceneViews
from registry import SceneBundle
from registry.errors import UsageError


def show_views(arguments: argparse.Namespace, bundle: SceneBundle, registry_root: Path) -> int:
    """Compute the views of a scene's objects, or load them from the stage cache, and write contact sheets."""
    results = StageResults.find(bundle, registry_root, arguments.work_dir)
    stage = next(s for s in STAGES if s.name == "views")
    for name in stage.needs:
        if results.get(name) is None:
            raise UsageError(
                f"{arguments.scene}: views need the stage {name}, but {results.missing[name]}. If it was reconstructed "
                f"with --work-dir, give the same folder here."
            )
    assert results.work_dir is not None  # the results are from there
    kept = bundle.scene["report"]["config"].get("avo")
    config = replace(PipelineConfig(), avo=AvoConfig(**kept) if kept else AvoConfig())
    for text in arguments.set:
        if not text.strip().startswith("avo."):
            raise UsageError(
                f"--set {text}: `show --views` takes options of avo only, for example avo.strategy=canonical"
            )
        config = config.with_option(text)
    run = Run(
        Path(bundle.scene["source"]["file"]),
        config,
        StageStore(results.work_dir),
        listener=make_listener(quiet=arguments.json),
        results={name: results.get(name) for name in stage.needs},
        keys={name: results.folders[name].name.rpartition("-")[2] for name in stage.needs},
        input_digest=bundle.scene["report"]["volatile"]["work"]["input_digest"],
    )
    run.complete(stage.name)
    views = run.results[stage.name]
    names = {item["id"]: item["label"] for item in bundle.scene["objects"]}
    folder = arguments.out or Path(f"{arguments.scene}_views")
    with output_errors(folder):
        files = write_view_sheets(views, names, folder)
    if arguments.json:
        print(
            json.dumps(
                {"strategy": views.strategy, "things": _facts(views), "files": [str(f) for f in files]}
            )
        )
        return 0
    for target in views.targets:
        seen = ", ".join(f"{view.visibility:.0%}" for view in target.views) or "nothing: no view shows it"
        print(f"{target.ids[0]:4d}  {names.get(target.ids[0], ''):<22} visible in its views: {seen}")
    print(
        f"contact sheets ({views.strategy}): {', '.join(str(file) for file in files) or 'none, there are no objects'}"
    )
    return 0


def _facts(views: SceneViews) -> list[dict]:
    names = ("visibility", "gain", "fronts", "origin")
    return [
        {
            "id": target.ids[0],
            "views": [
                {"world_from_camera": view.world_from_camera.tolist()}
                | {name: getattr(view, name) for name in names}
                for view in target.views
            ],
        }
        for target in views.targets
    ]
