"""`simrecon report`: writes one HTML page about a scene."""

import argparse
from pathlib import Path

from reconstruction.commands.options import add_common, add_scene, add_verb, path_or_address, write_output
from reconstruction.commands.truth import add_ground_truth, split_truth


def add_parser(verbs: argparse._SubParsersAction) -> None:
    """Add the verb."""
    parser = add_verb(
        verbs,
        "report",
        "write an HTML page with the results, costs and errors of every stage",
        "Write one self-contained HTML page about a scene: frames, depth, surface, instances, objects, "
        "scene graph, assembly, physics and timings; with --ground-truth also error maps, or outlines drawn by hand "
        "over the results. A page of `simrecon studio SCENE --export` in the same folder is linked to.",
    )
    add_scene(parser)
    add = parser.add_argument
    add("--out", type=Path, metavar="FILE.html", help="output file (default: SCENE.html)")
    add_ground_truth(
        parser, "ground truth of the video (docs/evaluation.md), for error maps; or file of outlines"
    )
    add(
        "--evaluation",
        type=Path,
        metavar="FILE",
        help="output of `simrecon evaluate --json FILE`, to save the minute of computing it",
    )
    add(
        "--work-dir",
        type=path_or_address,
        metavar="DIR",
        help="as given to `simrecon reconstruct --work-dir`",
    )
    add("--quiet", action="store_true", help="no progress")
    add_common(parser, json=False)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Write the page."""
    from reconstruction.commands.reporting import make_listener
    from reconstruction.measure.report.collect import by_reason
    from reconstruction.measure.report.page import build_page, find_room_page, read_evaluation
    from reconstruction.measure.stage_results import StageResults
    from registry import open_registry
    from registry.errors import UsageError

    out = arguments.out or Path(f"{arguments.scene}.html")
    if out.is_dir() or not out.absolute().parent.is_dir():
        raise UsageError(f"--out {out}: give a file name in an existing folder")
    ground_truth, labels = split_truth(arguments.ground_truth)
    registry = open_registry(arguments.registry)
    bundle = registry.load(arguments.scene)
    stages = StageResults.find(bundle, registry.root, arguments.work_dir)
    evaluation = None if arguments.evaluation is None else read_evaluation(arguments.evaluation, bundle)
    listener = make_listener(quiet=arguments.quiet)
    with listener:
        listener.begin_stage("report", 1, 1, False)
        room_page = find_room_page(out.absolute().parent, arguments.scene)
        page = build_page(
            bundle, stages, ground_truth, evaluation, labels=labels, room_page=room_page, progress=listener
        )
        listener.end_stage("report", None)
    write_output(out, page, "--out")
    for reason, names in by_reason(stages.missing).items():
        print(f"left out: {', '.join(names)}: {reason}")
    print(f"{out} ({out.stat().st_size / 1e6:.1f} MB)")
    return 0
