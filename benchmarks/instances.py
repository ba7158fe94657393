"""How well things are found: recall by size, support and clutter, and what the instances stage costs.

    python -m benchmarks.instances --captures ROOMS ../shared/bench                     # the stage alone: quick
    python -m benchmarks.instances --captures ROOMS ../shared/bench --until scene       # the boxes of whole scenes
    python -m benchmarks.instances --captures ROOMS --variants default true-masks --growth ROOMS/cluttered16

Until `instances`, captures are reconstructed up to that stage only and its own boxes are measured; stages before it
come from the work folder that `python -m benchmarks.run` uses, too, so that after a change of the stage a capture takes
seconds. Until `scene`, everything is as `benchmarks.run` does and keeps it, and the stage is measured as well. Captures
are pooled by the folder that they lie in.
"""

import argparse
import json
import os
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.captures import Capture, find_captures
from benchmarks.command import KEPT_RESULTS, guarded
from benchmarks.instances_page import GROWTH_FILE, Measured, write_instances_page
from benchmarks.machine import ROOT, describe_code, describe_machine
from benchmarks.results import load_result, result_path
from benchmarks.run import add_arguments, measure_scenes
from benchmarks.variants import Variant, choose_variants, home_of
from reconstruction.cache import StageStore, digest_input
from reconstruction.runner import Run
from registry.errors import SimReconError, UsageError

DEFAULT_PAGE = ROOT / "docs" / "instances_benchmark.md"
GROWTH_VOXELS_M = (0.028, 0.022, 0.018, 0.014, 0.011)  # about 30,000 to 230,000 points of a room
_GROWTH_VERTICES = (
    600_000  # more than the smallest voxels give: the bound on the mesh must not hide the growth
)


@dataclass(frozen=True)
class StageFigures:
    """What is kept of the instances stage of one capture in one variant."""

    arguments: list[str]
    inputs: str  # digest of the capture
    sources: str  # digest of the code
    commit: str
    dirty: bool
    date: str
    machine: dict
    figures: dict[str, Any]  # of reconstruction.measure.object_boxes
    surface_points: int
    keyframes: int
    wall_s: float
    cpu_s: float
    notes: list[str]


def stage_run(source: Path, work_dir: Path, words: Sequence[str]) -> Run:
    """Return a run as `simrecon reconstruct SOURCE WORDS...` would do it, not started yet."""
    from reconstruction.cli import build_parser
    from reconstruction.commands.reconstruct import config_of, oracle_of

    arguments = build_parser().parse_args(["reconstruct", str(source), *words])
    store = StageStore(work_dir, KEPT_RESULTS)
    return Run(source, config_of(arguments), store, oracle=oracle_of(arguments))


def work_of(out: Path, capture: Capture) -> Path:
    """Return the work folder that `benchmarks.run` uses for a capture, too."""
    return home_of(out, capture) / "work" / digest_input(capture.source)[:16]


def measure_stage(capture: Capture, variant: Variant, out: Path, inputs: str, code: dict) -> StageFigures:
    """Reconstruct up to the instances and measure their boxes; stages that are kept are not done again."""
    from reconstruction.measure.alignment import align
    from reconstruction.measure.ground_truth import GroundTruth
    from reconstruction.measure.object_boxes import instance_box_figures

    run = stage_run(capture.source, work_of(out, capture), variant.arguments_for(capture))
    run.execute("instances")
    truth = GroundTruth.load(capture.ground_truth)
    posed, _ = run.in_world()
    indices = [*posed.indices, *posed.held_out_indices]
    poses = [*posed.world_from_camera, *posed.held_out_world_from_camera]
    alignment = align({int(i): p for i, p in zip(indices, poses)}, truth.world_from_camera, truth.up)
    surface, usage = run.results["surface"], run.usage["instances"]
    return StageFigures(
        arguments=list(variant.arguments),
        inputs=inputs,
        sources=code["sources"],
        commit=code["commit"],
        dirty=code["dirty"],
        date=datetime.now(timezone.utc).strftime("%Y-%m-%dT%H:%M:%SZ"),
        machine=describe_machine(),
        figures=instance_box_figures(surface, run.results["instances"], alignment, truth),
        surface_points=len(surface.vertices),
        keyframes=len(posed.images),
        wall_s=usage.wall_s,
        cpu_s=usage.cpu_s,
        notes=[note for note in run.notes if note.startswith("instances:")],
    )


def stage_path(out: Path, capture: Capture, variant: Variant) -> Path:
    """Return where the figures of the stage are kept, apart from those of whole scenes."""
    return out / capture.name / "instances" / f"{variant.name}.json"


def measure_stages(
    captures: Sequence[Capture], variants: Sequence[Variant], out: Path, arguments: argparse.Namespace
) -> int:
    """Measure what is not done yet and keep the figures; return how many failed."""
    failed = 0
    for capture in captures:
        inputs = capture.digest()
        for variant in variants:
            label, path = f"{capture.name} / {variant.name}", stage_path(out, capture, variant)
            code = describe_code()
            known = _load_stage(path)
            fresh = known is not None and (known.inputs, known.arguments) == (inputs, list(variant.arguments))
            if fresh and not arguments.force and (arguments.keep_stale or known.sources == code["sources"]):
                print(f"{label}: at {known.commit}, kept", flush=True)
                continue
            print(f"{label}: {'to do' if arguments.dry_run else '...'}", flush=True)
            if arguments.dry_run:
                continue
            try:
                figures = measure_stage(capture, variant, out, inputs, code)
            except SimReconError as error:
                print(f"{label}: failed: {error}", flush=True)
                failed += 1
                continue
            path.parent.mkdir(parents=True, exist_ok=True)
            partial = path.with_suffix(f".{os.getpid()}.partial")
            partial.write_text(json.dumps(asdict(figures), indent=1, default=float) + "\n")
            partial.replace(path)
            found = figures.figures
            print(
                f"{label}: recall {found['object_recall_25']:.2f}, precision {found['object_precision_25']:.2f}, "
                f"recall at 0.5 {found['object_recall_50']:.2f}, {figures.cpu_s:.1f} s CPU",
                flush=True,
            )
    return failed


def _load_stage(path: Path) -> StageFigures | None:
    try:
        return StageFigures(**json.loads(path.read_text()))
    except FileNotFoundError:
        return None
    except (ValueError, TypeError) as error:
        raise UsageError(f"{path}: not what this command keeps ({error}); delete it and run again") from error


def stage_results(captures: Sequence[Capture], variants: Sequence[Variant], out: Path) -> list[Measured]:
    """Return what was measured of the stage alone."""
    measured = []
    for capture in captures:
        for variant in variants:
            kept = _load_stage(stage_path(out, capture, variant))
            if kept is not None and _has_records(kept.figures["objects"]):
                place = {"capture": capture.name, "group": capture.ground_truth.parent.parent.name}
                about = {name: getattr(kept, name) for name in _SHARED}
                figures = {k: v for k, v in kept.figures.items() if k != "objects"}
                measured.append(
                    Measured(**place, variant=variant.name, meaning=variant.meaning, figures=figures,
                             records=kept.figures["objects"], surface_points=kept.surface_points,
                             wall_s=kept.wall_s, cpu_s=kept.cpu_s, **about)
                )  # fmt: skip
    return measured


_SHARED = ("commit", "dirty", "sources", "date", "machine")


def _has_records(records: Sequence[dict[str, Any]]) -> bool:
    """Tell whether records of objects have what the page shows; those of older code have not."""
    return all({"found_25", "gap_cm", "visible_pixels"} <= record.keys() for record in records)


def _all_missed(capture: Capture) -> list[dict[str, Any]]:
    """Return the records of a scene that failed: leaving it out would make the others look better."""
    from reconstruction.measure.ground_truth import GroundTruth
    from reconstruction.measure.object_boxes import match_boxes, object_records
    from reconstruction.measure.object_facts import object_facts

    truth = GroundTruth.load(capture.ground_truth)
    nothing = match_boxes(truth.evaluated, np.zeros((0, 2, 3)))
    return object_records(truth.evaluated, object_facts(truth), nothing, [])


def scene_results(captures: Sequence[Capture], variants: Sequence[Variant], out: Path) -> list[Measured]:
    """Return what was measured of whole scenes; one that failed missed everything."""
    measured = []
    for capture in captures:
        for variant in variants:
            path = result_path(out, capture.name, variant.name)
            if not path.is_file():
                continue
            kept = load_result(path)
            if kept.failed:
                records, found, seconds = _all_missed(capture), 0, 0.0
                print(f"{capture.name} / {variant.name}: {kept.reason('objects')}; all missed", flush=True)
            else:
                records, found = kept.evaluation["objects"], kept.objects
                seconds = kept.report["timings_s"]["instances"]
            if not _has_records(records):
                print(
                    f"{capture.name} / {variant.name}: by older code, not in the tables; run it again",
                    flush=True,
                )
                continue
            measured.append(
                Measured(
                    capture=capture.name,
                    group=capture.ground_truth.parent.parent.name,
                    variant=variant.name,
                    meaning=variant.meaning,
                    figures={"found": found},
                    records=records,
                    surface_points=None,
                    wall_s=seconds,
                    cpu_s=None,
                    **{name: getattr(kept, name) for name in _SHARED},
                )
            )
    return measured


def measure_growth(source: Path, work_dir: Path, words: Sequence[str]) -> list[dict[str, float]]:
    """Time the instances stage on surfaces of one capture with ever smaller voxels.

    Stages before the surface are taken from the work folder, or done there. The first size is done twice and its first
    pass thrown away: it compiles what is not compiled yet.

    Returns:
        For each size `voxel_mm`, `points` of the surface, `cpu_s` and `wall_s` of the stage.
    """
    run = stage_run(source, work_dir, words)
    run.execute("gaussians")
    rows = []
    for number, voxel in enumerate([GROWTH_VOXELS_M[0], *GROWTH_VOXELS_M]):
        surface = replace(run.config.surface, voxel_size_m=voxel, max_vertices=_GROWTH_VERTICES)
        with tempfile.TemporaryDirectory() as folder:
            for stage, key in run.keys.items():
                for kept in work_dir.glob(f"*_{stage}-{key}"):
                    (Path(folder) / kept.name).symlink_to(kept.resolve())
            config = replace(run.config, surface=surface)
            timed = replace(run, config=config, store=StageStore(Path(folder)), results={}, keys={}, usage={})
            timed.execute("instances")
            usage, points = timed.usage["instances"], len(timed.results["surface"].vertices)
        if number:
            rows.append(
                {"voxel_mm": 1000 * voxel, "points": points, "cpu_s": usage.cpu_s, "wall_s": usage.wall_s}
            )
            print(f"{1000 * voxel:g} mm: {points} points, {usage.cpu_s:.1f} s CPU", flush=True)
    return rows


def build_parser() -> argparse.ArgumentParser:
    """Return the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.instances",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_arguments(parser)
    parser.add_argument(
        "--until", choices=("instances", "scene"), default="instances", help="what is measured"
    )
    parser.add_argument("--page", type=Path, default=DEFAULT_PAGE, metavar="FILE", help="the page to write")
    parser.add_argument(
        "--growth", type=Path, metavar="CAPTURE", help="time the stage on surfaces of this one"
    )
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns 0 if everything has figures, 1 if something failed, 130 if interrupted."""
    arguments = build_parser().parse_args(argv)
    return guarded("benchmarks.instances", lambda: _run(arguments))


def _run(arguments: argparse.Namespace) -> int:
    captures = [c for c in find_captures(arguments.captures, arguments.only) if c.truth == "scene"]
    if not captures:
        raise UsageError(
            "--captures: none of them has a ground truth with scene.json; nothing can be found or missed"
        )
    names = arguments.variants or ([] if arguments.variant else ["default"])
    variants, out = choose_variants(names, arguments.variant), arguments.out.resolve()
    stage_only = arguments.until == "instances"
    failed = 0 if stage_only else measure_scenes(captures, variants, out, arguments)
    if (
        stage_only or not arguments.discard_stages
    ):  # after a whole scene, the stage's own boxes only need measuring
        failed += measure_stages(captures, variants, out, arguments)
    if arguments.dry_run:
        return 0
    if arguments.growth:
        (capture,) = find_captures([arguments.growth])
        rows = measure_growth(capture.source, work_of(out, capture), variants[0].arguments_for(capture))
        out.mkdir(parents=True, exist_ok=True)
        kept = {"capture": capture.name, "variant": variants[0].name, "rows": rows, **describe_code()}
        (out / GROWTH_FILE).write_text(json.dumps(kept, indent=1) + "\n")
    stages, scenes = stage_results(captures, variants, out), scene_results(captures, variants, out)
    write_instances_page(stages, scenes, out / GROWTH_FILE, arguments.page, describe_code())
    print(f"{arguments.page} is written", flush=True)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
