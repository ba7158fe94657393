"""`simrecon evaluate`: a scene against the truth."""

import argparse
import json
from pathlib import Path

_DESCRIPTION = """Measure SCENE against the truth: cameras, geometry, objects, relations, pictures, physics, and the
stages that it was made by. Without --ground-truth only what needs none is measured: physics, pictures of kept-out
frames, registration. With LABELS.json, outlines that were drawn by hand on a few frames, it is also measured
which of the outlined things were found, which found objects are real, and who stands on whom."""

_EPILOG = """the truth is a folder with scene.json (cameras, entities), meshes/, depth/ and instances/, or with
cameras.json and depth/ alone; see docs/evaluation.md for the format and for what each figure means. Labels are
the project's own format, COCO or labelme polygons (also a folder of labelme files), one name a thing; label
frames whose number is a multiple of ten.

examples:
  simrecon evaluate scene0001 --ground-truth capture/ground_truth
  simrecon evaluate scene0001 --ground-truth capture/ground_truth --json figures.json
  simrecon evaluate kitchen --video kitchen.mp4
  simrecon evaluate kitchen --ground-truth labels.json
  simrecon evaluate kitchen --ground-truth kitchen/ground_truth --ground-truth labels.json
"""


def add_parser(verbs: argparse._SubParsersAction) -> None:
    """Register the verb."""
    from reconstruction.commands.options import add_common
    from reconstruction.commands.truth import add_ground_truth

    parser = verbs.add_parser(
        "evaluate",
        help="measure a scene against the truth",
        description=_DESCRIPTION,
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("scene", metavar="SCENE", help="a scene id, for example scene0001")
    add_ground_truth(parser, "the folder with the truth, or a file of outlines drawn by hand")
    parser.add_argument(
        "--json",
        type=Path,
        metavar="FILE",
        help="also write everything as JSON; - prints it instead of the table",
    )
    parser.add_argument("--work-dir", type=Path, metavar="DIR", help="where the scene's stages are kept")
    parser.add_argument(
        "--video",
        type=Path,
        metavar="VIDEO",
        help="for kept-out frames, and names of images, where stages are gone",
    )
    parser.add_argument("--quiet", action="store_true", help="no progress")
    add_common(parser, json=False)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Evaluate, print the table, write the file."""
    from reconstruction.commands.reporting import make_listener
    from reconstruction.commands.truth import split_truth
    from reconstruction.measure import StageResults, evaluate_scene
    from reconstruction.measure.table import as_table
    from registry import SceneRegistry

    to_stdout = str(arguments.json) == "-"
    if arguments.json and not to_stdout:
        _check_writable(arguments.json)
    ground_truth, labels = split_truth(arguments.ground_truth)
    registry = SceneRegistry(arguments.registry)
    bundle = registry.load(arguments.scene)
    listener = make_listener(quiet=arguments.quiet or to_stdout)
    with listener:
        listener.begin_stage("evaluate", 1, 1, False)
        evaluation = evaluate_scene(
            bundle,
            ground_truth,
            labels=labels,
            stages=StageResults.find(bundle, registry.root, arguments.work_dir),
            video=arguments.video,
            progress=listener,
        )
        listener.end_stage("evaluate", None)
    text = json.dumps(evaluation.to_json(), indent=2)
    if to_stdout:
        print(text)
        return 0
    print(as_table(evaluation))
    if arguments.json:
        arguments.json.write_text(text + "\n", encoding="utf-8")
        print(f"\nwritten to {arguments.json}")
    return 0


def _check_writable(path: Path) -> None:
    """Refuse a bad output path before minutes of measuring."""
    from registry.errors import UsageError

    if path.is_dir():
        raise UsageError(f"--json {path}: is a folder; give a file name, for example {path / 'figures.json'}")
    if not path.absolute().parent.is_dir():
        raise UsageError(f"--json {path}: the folder {path.absolute().parent} does not exist")
