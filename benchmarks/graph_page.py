"""The page of the scene graph benchmark."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from benchmarks.machine import describe_code, describe_machine, machine_line
from benchmarks.table import table_lines

KINDS = (
    "on the floor", "on one thing", "on two things", "on three or more", "in a container", "on a wall",
)  # fmt: skip
_HEAD = """# Scene graph benchmark

<!-- Written by `python -m benchmarks.graph`; run it again instead of changing this file. -->

Rooms of the project's own generator with the true meshes in place of reconstructed ones and no hints from earlier
stages, so that relations ([The scene graph](scene_graph.md)) and merging alone are measured. Five sorts of rooms in
turn: mixed, with many stacks, with many containers, with full walls, crowded. F1 is over edges (child, relation,
parent)."""

_OFF = """Shapes are true; every thing stands where it truly does, or is moved along each axis and tilted, each for
itself. In brackets: how many there are."""
_LYING = """{rooms} rooms x {seeds} seeds. The backend knows the truth of what is in view, names another parent (or the
other relation) for the share *wrong* of its edges and drops the share *missing*, anew for every question. `online` is
the paper's merging with conflict resolution, `naive` keeps what came first, `global` asks one question about all.
Geometry helps none of them here: what no answer connects is put on the floor (*unconnected*). *Ahead*: rooms and seeds
in which `online` has more edges right than this one, less those in which it has fewer."""


@dataclass
class GeometryResult:
    """What the embedded backend gets right."""

    moved_m: float
    tilted_deg: float
    counts: dict[str, list[int]] = field(default_factory=lambda: {kind: [0, 0] for kind in KINDS})
    cpu_s: list[float] = field(default_factory=list)
    errors: list[str] = field(default_factory=list)

    def add(self, kind: str, right: bool) -> None:
        """Count an edge."""
        self.counts[kind][0] += right
        self.counts[kind][1] += 1

    @property
    def edges(self) -> int:
        """How many there are."""
        return sum(total for _, total in self.counts.values())

    @property
    def f1(self) -> float:
        """Over all edges; every object has one on either side."""
        return sum(right for right, _ in self.counts.values()) / max(self.edges, 1)


@dataclass
class LyingResult:
    """One way to merge under one share of lies; a figure a room and seed."""

    merging: str
    wrong: float
    missing: float
    f1: list[float] = field(default_factory=list)
    asked: list[int] = field(default_factory=list)
    orphans: list[float] = field(default_factory=list)
    forests: list[bool] = field(default_factory=list)


def write_graph_page(
    geometry: Sequence[GeometryResult], lies: Sequence[LyingResult], rooms: int, seeds: int, page: Path
) -> None:
    """Write the page."""
    code = describe_code()
    lines = [_HEAD, "", "## Geometry", "", *_geometry_lines(geometry)]
    lines += ["", "## A backend that lies", "", *_lying_lines(lies, rooms, seeds)]
    changed = " and changes" if code["dirty"] else ""
    lines += ["", f"Commit {code['commit']}{changed}; {machine_line(describe_machine())}."]
    page.parent.mkdir(parents=True, exist_ok=True)
    page.write_text("\n".join(lines) + "\n")


def _geometry_lines(results: Sequence[GeometryResult]) -> list[str]:
    heads = ("places", "F1", *KINDS, "edges", "CPU s a room")
    rows = []
    for result in results:
        shares = [
            f"{right / total:.3f} ({total})" if total else "" for right, total in result.counts.values()
        ]
        moved = f"up to {1000 * result.moved_m:.0f} mm and {result.tilted_deg:g} degrees off"
        name = moved if result.moved_m else "true"
        cpu_s = f"{np.mean(result.cpu_s):.2f}"
        rows.append((name, f"{result.f1:.3f}", *shares, str(result.edges), cpu_s))
    return [f"{len(results[0].cpu_s)} rooms. {_OFF}", "", *table_lines(heads, rows, 1)]


def _lying_lines(results: Sequence[LyingResult], rooms: int, seeds: int) -> list[str]:
    heads = ("wrong, missing", "merging", "F1", "+-", "unconnected", "questions", "forests", "ahead")
    rows = []
    for first in range(0, len(results), 3):
        online = np.array(results[first].f1)
        for result in results[first : first + 3]:
            f1 = np.array(result.f1)
            ahead = (online > f1).mean() - (online < f1).mean()
            rows.append(
                (
                    f"{result.wrong:.0%}, {result.missing:.0%}",
                    f"`{result.merging}`",
                    f"{f1.mean():.3f}",
                    f"{f1.std():.3f}",
                    f"{np.mean(result.orphans):.1%}",
                    f"{np.mean(result.asked):.1f}",
                    f"{np.mean(result.forests):.0%}",
                    "" if result.merging == "online" else f"{ahead:+.0%}",
                )
            )
    return [_LYING.format(rooms=rooms, seeds=seeds), "", *table_lines(heads, rows, 2)]
