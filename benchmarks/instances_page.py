"""The page of the instances benchmark: recall and precision, recall by what makes objects hard, misses, time."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.breakdown import Share, breakdown
from benchmarks.machine import machine_line
from benchmarks.scaling import line_fit
from benchmarks.table import table_lines

GROWTH_FILE = "instances_growth.json"
_BREAKDOWNS = {
    "size": "longest side of the object",
    "support": "what it is on",
    "gap": "gap to the nearest neighbor",
    "seen": "seen in all frames together",
}
_HEAD = """# Instances benchmark

<!-- Written by `python -m benchmarks.instances`; run it again instead of changing this file. -->

How well things are found in captures with full truth, and what is hard about those that are not.
[benchmarking.md](benchmarking.md#instances) says how to make these tables again, [evaluation.md](evaluation.md) defines
the figures. Recall and precision are pooled: all objects of a set of captures count alike. Brackets are Wilson's 95 %
intervals: where the rate would lie if more rooms of the same kind were measured. Objects of one room share its luck, so
the intervals are a little too narrow."""


@dataclass(frozen=True)
class Measured:
    """One capture in one variant, of the stage alone or of a whole scene."""

    capture: str
    group: str  # the folder that the capture lies in
    variant: str
    meaning: str
    figures: dict[str, Any]  # "found": how many objects
    records: list[dict[str, Any]]  # of the evaluated true objects
    surface_points: int | None
    wall_s: float  # of the instances stage
    cpu_s: float | None
    commit: str
    dirty: bool
    sources: str
    date: str
    machine: dict


def write_instances_page(
    stages: Sequence[Measured], scenes: Sequence[Measured], growth: Path, page: Path, code: dict
) -> None:
    """Write the page.

    Args:
        stages: of the instances stage alone.
        scenes: of whole scenes.
        growth: file of `measure_growth`; need not exist.
        page: to write.
        code: of the working tree; what was measured with other sources is marked.
    """
    measured_growth = json.loads(growth.read_text()) if growth.is_file() else None
    page.parent.mkdir(parents=True, exist_ok=True)
    page.write_text(render(stages, scenes, measured_growth, code))


def render(stages: Sequence[Measured], scenes: Sequence[Measured], growth: dict | None, code: dict) -> str:
    """Return the page's Markdown; see `write_instances_page`."""
    lines = [_HEAD]
    for title, results in (
        ("Whole scenes: the boxes that users get", scenes),
        ("The instances stage alone: boxes before meshes are made", stages),
    ):
        if results:
            lines += ["", f"## {title}", *_section(results)]
    lines += ["", "## Time", *_time(stages, scenes, growth)]
    lines += ["", "## Runs", "", *_runs([*scenes, *stages], code)]
    return "\n".join(lines) + "\n"


def pooled(results: Sequence[Measured], bound: int) -> tuple[Share, Share]:
    """Return recall and precision at an IoU bound (25 or 50, percent) over all objects of the results."""
    found = sum(sum(bool(r[f"found_{bound}"]) for r in m.records) for m in results)
    return Share(found, sum(len(m.records) for m in results)), Share(
        found, sum(m.figures["found"] for m in results)
    )


def _section(results: Sequence[Measured]) -> list[str]:
    groups = list(dict.fromkeys(m.group for m in results))
    heads = ["captures", "variant", "objects", "recall@.25 ↑", "prec@.25 ↑", "recall@.5 ↑", "prec@.5 ↑"]
    rows, single = [], []
    for group in groups:
        for variant in _variants(results):
            chosen = [m for m in results if (m.group, m.variant) == (group, variant)]
            if chosen:
                rows.append([f"{group} ({len(chosen)})", variant, *_rates(chosen, interval=True)])
                single += [[m.capture, variant, *_rates([m], interval=False)] for m in chosen]
    lines = ["", *table_lines(heads, rows, 2), "", *table_lines(["capture", *heads[1:]], single, 2)]
    for group in groups:
        lines += _breakdowns(group, [m for m in results if m.group == group])
    return lines + _missed(results)


def _variants(results: Sequence[Measured]) -> list[str]:
    return list(dict.fromkeys(m.variant for m in results))


def _rates(results: Sequence[Measured], *, interval: bool) -> list[str]:
    shares = [share for bound in (25, 50) for share in pooled(results, bound)]
    return [f"{shares[0].count}", *(_shown(share, interval) for share in shares)]


def _shown(share: Share, interval: bool = True) -> str:
    if not share.count:
        return "–"
    low, high = share.interval
    return f"{share.value:.2f} [{low:.2f}, {high:.2f}]" if interval else f"{share.value:.2f}"


def _breakdowns(group: str, results: Sequence[Measured]) -> list[str]:
    variants = _variants(results)
    tables = {v: breakdown([r for m in results if m.variant == v for r in m.records]) for v in variants}
    lines = ["", f"### Recall by what is hard: {group}"]
    for key, title in _BREAKDOWNS.items():
        bins = {v: {b.name: b for b in tables[v][key]} for v in variants}
        names = list(dict.fromkeys(b.name for v in variants for b in tables[v][key]))
        names = [n for n in names if n != "all"] + ["all"]
        heads = [title, "objects"]
        for v in variants:
            heads += [f"{v} @.25", f"{v} @.5"]
        rows = []
        for name in names:
            present = [bins[v].get(name) for v in variants]
            count = max(b.recall_25.count for b in present if b is not None)
            cells = [
                c
                for b in present
                for c in (["–"] * 2 if b is None else [_shown(b.recall_25), _shown(b.recall_50)])
            ]
            rows.append([name, str(count), *cells])
        lines += ["", *table_lines(heads, rows, 1)]
    return lines


def _missed(results: Sequence[Measured]) -> list[str]:
    """List the objects that were missed at 0.25, the smallest first."""
    rows = []
    for m in results:
        for r in sorted(m.records, key=lambda r: r["longest_side_cm"]):
            if not r["found_25"]:
                gap = "–" if r["gap_cm"] is None else f"{r['gap_cm']:.1f}"
                cells = [m.capture, m.variant, r["name"], r["support"], f"{r['longest_side_cm']:.0f}", gap]
                rows.append([*cells, f"{r['visible_pixels']:,}", f"{r['box_iou']:.2f}"])
    heads = [
        "capture",
        "variant",
        "object",
        "on",
        "longest side cm",
        "gap cm",
        "pixels in all frames",
        "best box IoU",
    ]
    return ["", "### Missed at 0.25", "", *(table_lines(heads, rows, 4) if rows else ["Nothing."])]


def _time(stages: Sequence[Measured], scenes: Sequence[Measured], growth: dict | None) -> list[str]:
    lines: list[str] = []
    if stages:
        heads = ["capture", "variant", "surface points", "CPU s", "wall s"]
        rows = [
            [m.capture, m.variant, f"{m.surface_points:,}", f"{m.cpu_s:.1f}", f"{m.wall_s:.1f}"]
            for m in stages
        ]
        lines += ["", "Of the instances stage, as it was when its result was computed:", ""]
        lines += table_lines(heads, rows, 2)
    if scenes:
        worst = max(scenes, key=lambda m: m.wall_s)
        lines += [
            "",
            f"In whole scenes at most {worst.wall_s:.0f} s of wall time ({worst.capture}, {worst.variant}).",
        ]
    if growth:
        points = np.array([row["points"] for row in growth["rows"]], float)
        seconds = np.array([row["cpu_s"] for row in growth["rows"]])
        slope, intercept, fit = line_fit(points / 1000, seconds)
        text = f"{slope:.3f} s of CPU a thousand surface points + {intercept:.1f} s, R² {fit:.3f}"
        lines += ["", f"Growth on {growth['capture']} ({growth['variant']}), whose surface was made with ever smaller "
                  f"voxels (commit {growth['commit']}): **{text}**.", ""]  # fmt: skip
        rows = [
            [f"{r['voxel_mm']:g}", f"{r['points']:,}", f"{r['cpu_s']:.1f}", f"{r['wall_s']:.1f}"]
            for r in growth["rows"]
        ]
        lines += table_lines(["voxel mm", "surface points", "CPU s", "wall s"], rows, 0)
    return lines or ["", "Not measured yet."]


def _runs(results: Sequence[Measured], code: dict) -> list[str]:
    commits = {}
    for m in results:
        mark = (" + changes" if m.dirty else "") + ("" if m.sources == code["sources"] else " †")
        commits.setdefault(m.commit + mark, []).append(m.date)
    told = [f"{commit} ({min(dates)[:10]}, {len(dates)} results)" for commit, dates in commits.items()]
    machines = list(dict.fromkeys(machine_line(m.machine) for m in results))
    meanings = {m.variant: m.meaning for m in results}
    return [
        f"Commits: {', '.join(told)}. †: of another state of the code than the one that wrote this page.",
        "",
        f"Machine: {'; '.join(machines)}.",
        "",
        "Variants: " + "; ".join(f"**{name}** {text}" for name, text in meanings.items()) + ".",
    ]
