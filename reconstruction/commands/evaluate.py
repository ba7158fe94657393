"""`simrecon evaluate`: compares a scene with the ground truth."""

import argparse
import json
from pathlib import Path

from reconstruction.commands.options import add_common, add_scene, add_verb, path_or_address, write_output
from reconstruction.commands.truth import add_ground_truth, split_truth

_DESCRIPTION = """Compare SCENE with the ground truth: cameras, geometry, objects, relations, images, physics, and the
results of each stage. Without --ground-truth, only figures that need none: physics, images of held-out frames,
registration. With LABELS.json, outlines drawn by hand on a few frames, also: which outlined things were found, which
found objects are real, and which object stands on which."""

_EPILOG = """The ground truth is a folder with scene.json (cameras, entities), meshes/, depth/ and instances/, or with
cameras.json and depth/ alone; docs/evaluation.md explains the format and each figure. Labels are in the project's own
format, COCO, or labelme polygons (also a folder of labelme files), with one name for each thing. Label frames whose
number is a multiple of ten.

examples:
  simrecon evaluate scene0001 --ground-truth capture/ground_truth
  simrecon evaluate scene0001 --ground-truth capture/ground_truth --json figures.json
  simrecon evaluate kitchen --video kitchen.mp4
  simrecon evaluate kitchen --ground-truth labels.json
  simrecon evaluate kitchen --ground-truth kitchen/ground_truth --ground-truth labels.json
"""


def add_parser(verbs: argparse._SubParsersAction) -> None:
    """Add the verb."""
    parser = add_verb(verbs, "evaluate", "compare a scene with the ground truth", _DESCRIPTION, _EPILOG)
    add_scene(parser)
    add_ground_truth(parser, "folder with the ground truth, or file of outlines drawn by hand")
    add = parser.add_argument
    add("--json", type=Path, metavar="FILE", help="also write JSON; -: print JSON instead of the table")
    add("--work-dir", type=path_or_address, metavar="DIR", help="stage cache of the scene")
    add("--video", type=Path, metavar="VIDEO", help="for held-out frames, if the stage cache is gone")
    add("--quiet", action="store_true", help="no progress")
    add_common(parser, json=False)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Evaluate a scene, print the table, write the file."""
    from reconstruction.commands.reporting import make_listener
    from reconstruction.measure import StageResults, evaluate_scene
    from reconstruction.measure.table import as_table
    from registry import open_registry

    to_stdout = str(arguments.json) == "-"
    if arguments.json and not to_stdout:
        _check_writable(arguments.json)
    ground_truth, labels = split_truth(arguments.ground_truth)
    registry = open_registry(arguments.registry)
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
        write_output(arguments.json, text + "\n", "--json")
        print(f"\nwritten to {arguments.json}")
    return 0


def _check_writable(path: Path) -> None:
    """Raise now, not after minutes, if a file cannot be written.

    Raises:
        UsageError: the path is a folder, or its folder does not exist.
    """
    from registry.errors import UsageError

    if path.is_dir():
        raise UsageError(
            f"--json {path}: this is a folder; give a file name, for example {path / 'figures.json'}"
        )
    if not path.absolute().parent.is_dir():
        raise UsageError(f"--json {path}: the folder {path.absolute().parent} does not exist")
