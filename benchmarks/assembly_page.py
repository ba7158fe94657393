"""The page of the assembly benchmark."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.machine import machine_line
from benchmarks.table import table_lines

_HEAD = """# Assembly benchmark

<!-- Written by `python -m benchmarks.assembly`; run it again instead of changing this file. -->

What the physics makes of scenes after [assembly](assembly.md), beside the same scenes left as they were reconstructed
(`in-situ`) and after a search for poses without overlap (`mcmc`). All three are measured by the same report card: all
movable objects together, undamped, 10 s.

- *stable*: movable objects that move less than 2 cm and turn less than 5°; *whole*: scenes in which all do, nothing
  overlaps by more than 1 mm, floats, or still moves at the end.
- *immovable*: objects that assembly could not make stand and therefore fixed; the other methods never do that.
- *supports real*, *attached real*: relations of the scene graph that are contacts at rest. Where the video shows
  nothing that carries a thing, the graph attaches it to a floor or wall, and it is fixed where it was seen.
- *unknown*: objects of which half or more rests on something that is not their parent in the graph.
- *off*: median distance from where the object's middle truly is, in true metres after the alignment that
  [evaluation](evaluation.md) uses; *moved*: median distance from where it was reconstructed.
- *s an object*: CPU time of the whole method, its report card included."""
_HEADINGS = {
    "generated rooms": "True shapes and relations, 5 to 40 objects with stacks and things in containers; poses off by "
    "4 mm along each axis, 1° of tilt and 2° of yaw (1-sigma).",
    "captures with truth": "Reconstructed from video with default options, shapes and relations included; *off* is of "
    "objects whose box shares a quarter with a true one.",
    "captures without objects in their truth": "Reconstructed from video with default options.",
}


def write_assembly_page(kept: Sequence[dict[str, Any]], page: Path) -> None:
    """Write the page from the kept results of scenes."""
    lines = [_HEAD]
    for group, text in _HEADINGS.items():
        records = [record for record in kept if record["group"] == group]
        if not records:
            continue
        count = sum(record["objects"] for record in records)
        lines += ["", f"## {group.capitalize()} ({len(records)}, {count} objects)", "", text, ""]
        lines += _methods(records)
        if group != "generated rooms":
            lines += ["", *_scenes(records)]
    if kept:
        lines += ["", f"Measured on {machine_line(kept[-1]['machine'])}."]
    page.parent.mkdir(parents=True, exist_ok=True)
    page.write_text("\n".join(lines) + "\n")


def _methods(records: Sequence[dict[str, Any]]) -> list[str]:
    rows = []
    for method in ("hierarchical", "in-situ", "mcmc"):
        chosen = [record for record in records if method in record["methods"]]
        if chosen:
            figures = _figures([record["methods"][method] for record in chosen], chosen)
            rows.append([f"`{method}`", str(len(chosen)), *figures])
    head = ["method", "scenes", "stable, %", "whole, %", "deepest overlap, mm", "floating, %", "immovable",
            "supports real, %", "attached real, %", "unknown", "off, cm", "moved, cm", "s an object"]  # fmt: skip
    return table_lines(head, rows, 1)


def _figures(values: Sequence[dict[str, Any]], records: Sequence[dict[str, Any]]) -> list[str]:
    def total(key: str) -> float:
        return sum(value[key] for value in values)

    movable = max(total("dynamic_objects"), 1)
    off, moved = _pooled(values, "off_m"), _pooled(values, "moved_m")
    return [
        f"{100 * total('stable_objects') / movable:.1f}",
        f"{100 * np.mean([not value['failures'] for value in values]):.0f}",
        f"{max(value['spawn_penetration_mm'] for value in values):.2f}",
        f"{100 * total('floating_objects') / movable:.1f}",
        f"{total('made_immovable'):.0f}",
        *(
            f"{100 * total(f'{kind}_edges_real') / max(total(f'{kind}_edges'), 1):.0f}"
            for kind in ("support", "attached")
        ),
        f"{total('supports_without_edge'):.0f}",
        f"{100 * np.median(off):.2f}" if len(off) else "",
        f"{100 * np.median(moved):.2f}" if len(moved) else "",
        f"{total('cpu_s') / sum(record['objects'] for record in records):.2f}",
    ]


def _pooled(values: Sequence[dict[str, Any]], key: str) -> list[float]:
    return [x for value in values for x in value[key]]


def _scenes(records: Sequence[dict[str, Any]]) -> list[str]:
    rows = []
    for record in records:
        if len(record["methods"]) < 3:
            continue
        value = record["methods"]["hierarchical"]
        beside = [f"{100 * record['methods'][m]['stable_rate']:.0f}" for m in ("in-situ", "mcmc")]
        off = f"{100 * np.median(value['off_m']):.2f}" if value["off_m"] else ""
        rows.append(
            [record["scene"], str(record["objects"]), str(value["dynamic_objects"]), str(value["made_immovable"]),
             f"{100 * value['stable_rate']:.0f}", *beside, f"{value['spawn_penetration_mm']:.2f}",
             f"{100 * value['floating_rate']:.0f}", off, f"{value['cpu_s'] / max(record['objects'], 1):.2f}"]
        )  # fmt: skip
    head = ["scene, assembled", "objects", "movable", "immovable", "stable, %", "in-situ", "mcmc", "overlap, mm",
            "floating, %", "off, cm", "s an object"]  # fmt: skip
    return table_lines(head, rows, 1)
