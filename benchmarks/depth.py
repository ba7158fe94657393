"""The depth ruler: what the depth maps of captures are worth against the truth.

    python -m benchmarks.depth dev_clutter kitchen ../rooms/room7 --set depth.planes=128 --pictures out/pictures
    python -m benchmarks.depth dev_clutter --stage gaussians --perturb 5           # mean and spread of five runs

Frames, poses and depth (with `--stage gaussians`, also the Gaussians, whose depth maps are the corrected ones) come
from the work folders of `python -m benchmarks.run`: what is there is not done again. See docs/benchmarking.md.
"""

import argparse
import json
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.captures import Capture, find_captures
from benchmarks.command import guarded
from benchmarks.depth_figures import TrueView, depth_figures, draw_views, similarity, true_views
from benchmarks.instances import stage_run, work_of
from benchmarks.machine import ROOT, describe_code
from benchmarks.spread import spread_tree
from benchmarks.table import DEFAULT_OUT, table_lines
from reconstruction.core.types import DepthMaps
from reconstruction.measure.ground_truth import GroundTruth
from reconstruction.runner import Run
from registry.errors import UsageError

SCHEMA = "simrecon.depth-ruler/1"
_PLACES = (ROOT.parent / "shared" / "bench", ROOT.parent / "shared" / "real")
_COLUMNS = (  # figure, heading, digits of percent
    ("known", "known", 1),
    ("measured", "measured (2)", 1),
    ("completed", "completed (1)", 1),
    ("median_rel", "median error", 2),
    ("off", "off > 5 %", 1),
    ("measured_median_rel", "median (2)", 2),
    ("measured_off", "off (2)", 1),
    ("completed_median_rel", "median (1)", 2),
    ("completed_off", "off (1)", 1),
    ("new", "new", 1),
    ("new_median_rel", "median new", 2),
    ("new_off", "off new", 1),
    ("on_things", "on things", 1),
    ("on_things_each", "mean of things", 1),
    ("ring", "ring glued", 1),
)


def build_parser() -> argparse.ArgumentParser:
    """Build the command line's parser."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.depth",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add(
        "captures",
        nargs="+",
        metavar="CAPTURE",
        help="folders, or names in ../shared/bench and ../shared/real",
    )
    add(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="an option, as of simrecon reconstruct",
    )
    add("--preset", default="", metavar="NAME", help="as of simrecon reconstruct")
    add("--stage", choices=("depth", "gaussians"), default="depth", help="whose depth maps (default: depth)")
    add(
        "--reference", action="append", default=[], metavar="KEY=VALUE",
        help="also run with this option on top; pixels that are not known then are measured as new",
    )  # fmt: skip
    add("--perturb", type=int, default=1, metavar="N", help="N runs, depth perturbed in its last bits")
    add("--work-dir", type=Path, default=DEFAULT_OUT, metavar="DIR", help="where stage results are kept")
    add("--json", type=Path, metavar="FILE", help="write all figures")
    add("--pictures", type=Path, metavar="DIR", help="draw three keyframes of each capture")
    add("--verbose", action="store_true", help="list every thing")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line."""
    arguments = build_parser().parse_args(argv)
    return guarded("benchmarks", lambda: _run(arguments))


def _run(arguments: argparse.Namespace) -> int:
    if arguments.perturb > 1 and arguments.stage == "depth":
        raise UsageError("--perturb: depth itself is the same but for its last bits; add --stage gaussians")
    rows, code = [], describe_code()
    for capture in [_find(name) for name in arguments.captures]:
        print(f"{capture.name}: ...", file=sys.stderr, flush=True)
        row = {"capture": capture.name, **measure(capture, arguments)}
        rows.append(row)
        if arguments.json:
            arguments.json.parent.mkdir(parents=True, exist_ok=True)
            data = {
                "schema": SCHEMA,
                "code": code,
                "set": arguments.set,
                "stage": arguments.stage,
                "rows": rows,
            }
            arguments.json.write_text(json.dumps(data, indent=1, default=float) + "\n")
        if arguments.verbose:
            print("\n".join(_thing_lines(row)), flush=True)
    print("\n".join(report_lines(rows)))
    return 0


def _find(name: str) -> Capture:
    for place in (Path(name), *(folder / name for folder in _PLACES)):
        if place.is_dir():
            found = find_captures([place])
            if len(found) > 1:
                raise UsageError(f"{place}: several captures; name them one by one")
            return found[0]
    raise UsageError(
        f"{name}: no such folder, and no capture of this name in {' or '.join(map(str, _PLACES))}"
    )


def measure(capture: Capture, arguments: argparse.Namespace) -> dict[str, Any]:
    """Run the stages for a capture and measure its depth maps.

    Returns:
        The figures of the (first) run; `runs` and `spread` where there are several.
    """
    options = ["--preset", arguments.preset] if arguments.preset else []
    options += [word for text in arguments.set for word in ("--set", text)]
    began = time.perf_counter()
    first = _stages(capture, arguments, options)
    posed, depth = first.results["poses"], _maps(first, arguments.stage)
    truth = GroundTruth.load(capture.ground_truth) if capture.ground_truth else None
    scale, views, names = _truth(first, depth, truth)
    reference = None
    if arguments.reference:
        words = [word for text in arguments.reference for word in ("--set", text)]
        reference = _maps(_stages(capture, arguments, [*options, *words]), arguments.stage)
    runs = [depth_figures(depth, scale, views, names, reference)]
    for seed in range(1, arguments.perturb):
        again = _stages(capture, arguments, [*options, "--set", f"depth.perturb={seed}"])
        runs.append(depth_figures(_maps(again, arguments.stage), scale, views, names, reference))
    if arguments.pictures:
        draw_views(posed, depth, scale, views, arguments.pictures / capture.name)
    out = {**runs[0], "keyframes": len(posed.images), "wall_s": round(time.perf_counter() - began, 1)}
    out["stage_s"] = {name: round(usage.wall_s, 1) for name, usage in first.usage.items()}
    if len(runs) > 1:
        out |= {"runs": runs, "spread": spread_tree(runs)}
    return out


def _stages(capture: Capture, arguments: argparse.Namespace, words: Sequence[str]) -> Run:
    run = stage_run(capture.source, work_of(arguments.work_dir.resolve(), capture), words)
    run.execute(arguments.stage)
    return run


def _maps(run: Run, stage: str) -> DepthMaps:
    return run.results["gaussians"].depth if stage == "gaussians" else run.results["depth"]


def _truth(
    run: Run, depth: DepthMaps, truth: GroundTruth | None
) -> tuple[float, list[TrueView], Mapping[int, str]]:
    """Return metres per unit of the maps, the drawn truth, and the things' names."""
    if truth is None:
        return 1.0, [], {}
    posed = run.results["poses"]
    alignment = similarity(posed, truth)
    views = list(true_views(posed, depth.camera, truth, alignment))
    return alignment.scale, views, {e.id: e.name for e in truth.entities if not e.base}


def report_lines(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the table: shares and errors in percent, and means over the captures that have the figure.

    The mean of `ring` is over all ring pixels. Where there were several runs a cell is mean ± standard deviation.
    """
    shown = [c for c in _COLUMNS if any(row.get(c[0]) is not None for row in rows)]
    cells = [[row["capture"], *(_cell(row, key, digits) for key, _, digits in shown)] for row in rows]
    with_truth = [row for row in rows if row.get("pixels")]
    if len(with_truth) > 1:
        means = []
        for key, _, digits in shown:
            having = [row for row in with_truth if row.get(key) is not None]
            weights = [row["ring_px"] if key == "ring" else 1 for row in having]
            total = sum(w * _mean(row, key) for w, row in zip(weights, having))
            means.append(f"{100 * total / sum(weights):.{digits}f}" if sum(weights) else "–")
        cells.append(["mean of those with truth", *means])
    runs = max((len(row.get("runs", [1])) for row in rows), default=1)
    note = [f"Mean ± standard deviation of {runs} runs.", ""] if runs > 1 else []
    return [*note, *table_lines(["capture, %", *(head for _, head, _ in shown)], cells, 1)]


def _mean(row: Mapping[str, Any], key: str) -> float:
    return row["spread"][key]["mean"] if "spread" in row else row[key]


def _cell(row: Mapping[str, Any], key: str, digits: int) -> str:
    if row.get(key) is None:
        return "–"
    text = f"{100 * _mean(row, key):.{digits}f}"
    return f"{text} ± {100 * row['spread'][key]['sd']:.{digits}f}" if "spread" in row else text


def _thing_lines(row: Mapping[str, Any]) -> list[str]:
    things = sorted(row.get("things", {}).items(), key=lambda item: item[1]["right"])
    return [
        f"  {name:<28} {found['pixels']:>9} px, known {found['known']:6.1%}, within 2 % {found['right']:6.1%}"
        for name, found in things
    ]


if __name__ == "__main__":
    sys.exit(main())
