"""`simrecon report`: one HTML page about a scene, to look at and to send."""

import argparse
from pathlib import Path


def add_parser(verbs: argparse._SubParsersAction) -> None:
    """Register the verb."""
    from reconstruction.commands.options import add_common
    from reconstruction.commands.truth import add_ground_truth

    parser = verbs.add_parser(
        "report",
        help="one HTML page that shows what every stage made, what it cost and where it is wrong",
        description="Write one self-contained HTML page about a scene: frames, depth, surface, instances, objects, "
        "scene graph, assembly, physics and timings; with --ground-truth also what is wrong, and by how much, or "
        "outlines drawn by hand over what was found.",
    )
    parser.add_argument("scene", metavar="SCENE", help="a scene id, for example scene0001")
    parser.add_argument(
        "--out", type=Path, metavar="FILE.html", help="where to write it (default: SCENE.html)"
    )
    add_ground_truth(
        parser, "the truth of the video (docs/evaluation.md), adds error maps; or a file of outlines"
    )
    parser.add_argument(
        "--evaluation",
        type=Path,
        metavar="FILE",
        help="what `simrecon evaluate --json FILE` wrote, instead of measuring again (a minute)",
    )
    parser.add_argument(
        "--work-dir",
        type=Path,
        metavar="DIR",
        help="the folder that `simrecon reconstruct --work-dir` was given, if it was",
    )
    parser.add_argument("--quiet", action="store_true", help="no progress")
    add_common(parser, json=False)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Write the page."""
    from reconstruction.commands.reporting import make_listener
    from reconstruction.commands.truth import split_truth
    from reconstruction.measure.report.collect import by_reason
    from reconstruction.measure.report.page import build_page, read_evaluation
    from reconstruction.measure.stage_results import StageResults
    from registry import SceneRegistry
    from registry.errors import UsageError

    out = arguments.out or Path(f"{arguments.scene}.html")
    if out.is_dir() or not out.absolute().parent.is_dir():
        raise UsageError(f"--out {out}: give the name of a file in a folder that exists")
    ground_truth, labels = split_truth(arguments.ground_truth)
    registry = SceneRegistry(arguments.registry)
    bundle = registry.load(arguments.scene)
    stages = StageResults.find(bundle, registry.root, arguments.work_dir)
    evaluation = None if arguments.evaluation is None else read_evaluation(arguments.evaluation, bundle)
    listener = make_listener(quiet=arguments.quiet)
    with listener:
        listener.begin_stage("report", 1, 1, False)
        page = build_page(bundle, stages, ground_truth, evaluation, labels=labels, progress=listener)
        listener.end_stage("report", None)
    out.write_text(page, encoding="utf-8")
    for reason, names in by_reason(stages.missing).items():
        print(f"left out: {', '.join(names)}: {reason}")
    print(f"{out} ({out.stat().st_size / 1e6:.1f} MB)")
    return 0
