"""The page of the views benchmark."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.machine import machine_line
from benchmarks.table import table_lines

HIDDEN_FROM = 0.25  # share of its outline that other things hide over the film
TIE = 0.02  # of the surface
_OTHERS = ("max-visibility", "canonical", "avo-no-depth")
_HEAD = """# Views benchmark

<!-- Written by `python -m benchmarks.avo`; run it again instead of changing this file. -->

What the views of each strategy ([Active viewpoint optimization](avo.md)) see of a thing's **true** surface, all of
it, undersides and what no frame saw included: 3,000 points evenly on the true mesh, seen past everything in the true
scene. Each strategy is asked for four views of every object. The objects are the true ones, so that the views are
measured and not the cut; everything else is reconstructed. *Filmed* counts only surface that some frame of the video
saw: only that can have a picture. *Hidden* objects are those of which other things hide a quarter or more of the
outline over the film. A tie is a difference of at most 2 % of the surface. What cameras in free space all around an
object see together bounds what any views can: where a strategy comes within a tie of that, nothing is left to win."""


def write_avo_page(kept: Sequence[dict[str, Any]], page: Path) -> None:
    """Write the page from the kept results of captures."""
    lines = [_HEAD]
    records = [record for one in kept for record in one["objects"]]
    hidden = [record for record in records if record["hidden"] >= HIDDEN_FROM]
    for title, chosen in (("Hidden objects", hidden), ("All objects that were measured", records)):
        if chosen and not (chosen is records and len(hidden) == len(records)):
            lines += ["", f"## {title} ({len(chosen)})", "", *_strategies(chosen), "", *_wins(chosen)]
    lines += ["", "## Gradient, places, time", "", *_facts(records, kept)]
    words = (
        "The most hidden objects of each room; from the left four views of `avo`, of `max-visibility` and of "
        "`canonical`. Red: what is seen of the object."
    )
    lines += picture_lines(kept, page, "avo", "Views of things in", words)
    write_lines(lines, page)


def picture_lines(
    kept: Sequence[dict[str, Any]], page: Path, prefix: str, title: str, words: str
) -> list[str]:
    """Return the section of the pictures `images/PREFIX_CAPTURE.jpg` that are there; nothing where there are none."""
    folder = page.parent / "images"
    drawn = [one["capture"] for one in kept if (folder / f"{prefix}_{one['capture']}.jpg").is_file()]
    lines = ["", "## Pictures", "", words] if drawn else []
    for name in drawn:
        lines += ["", f"![{title} {name}](images/{prefix}_{name}.jpg)"]
    return lines


def write_lines(lines: Sequence[str], page: Path) -> None:
    """Write a page, with the folders above it."""
    page.parent.mkdir(parents=True, exist_ok=True)
    page.write_text("\n".join(lines) + "\n")


def _strategies(records: Sequence[dict[str, Any]]) -> list[str]:
    rows = []
    for name in records[0]["strategies"]:
        values = [record["strategies"][name] for record in records]

        def mean(key: str, values: Sequence[dict[str, Any]] = values) -> str:
            return f"{100 * np.mean([v[key] for v in values]):.1f}"

        rows.append(
            [f"`{name}`", mean("union"), mean("union_filmed"), mean("first"), mean("mean"),
             f"{np.mean([v['views'] for v in values]):.1f}",
             str(sum(len(v["in_wall"]) for v in values)), f"{np.mean([v['cpu_s'] for v in values]):.1f}"]
        )  # fmt: skip
    head = ["strategy", "four views, %", "of what was filmed, %", "first view, %", "a view, %", "views",
            "cameras inside something", "CPU s"]  # fmt: skip
    return table_lines(head, rows, 1)


def _wins(records: Sequence[dict[str, Any]]) -> list[str]:
    rows = []
    for other in _OTHERS:
        for key, title in (
            ("union", "four views"),
            ("union_filmed", "of what was filmed"),
            ("first", "first view"),
        ):
            gaps = np.array([r["strategies"]["avo"][key] - r["strategies"][other][key] for r in records])
            shares = [(gaps > TIE).mean(), (np.abs(gaps) <= TIE).mean(), (gaps < -TIE).mean()]
            rows.append([f"`{other}`", title, *(f"{100 * share:.0f} %" for share in shares)])
    best = {other: [r for r in records if _left(r, other) > TIE] for other in _OTHERS}
    for other, left in best.items():
        gaps = np.array([r["strategies"]["avo"]["union"] - r["strategies"][other]["union"] for r in left])
        if len(gaps):
            shares = [(gaps > TIE).mean(), (np.abs(gaps) <= TIE).mean(), (gaps < -TIE).mean()]
            title = f"four views, of the {len(left)} objects of which it leaves more than a tie"
            rows.append([f"`{other}`", title, *(f"{100 * share:.0f} %" for share in shares)])
    return table_lines(["`avo` beside", "by", "sees more", "ties", "sees less"], rows, 2)


def _left(record: dict[str, Any], strategy: str) -> float:
    """Return what cameras in free space see of an object and the views of a strategy do not, as a share of it."""
    entries = record["strategies"]
    most = max(record["seeable"], *(entry["union"] for entry in entries.values()))
    return most - entries[strategy]["union"]


def _facts(records: Sequence[dict[str, Any]], kept: Sequence[dict[str, Any]]) -> list[str]:
    errors = np.array([record["gradient_error"] for record in records])
    wide = np.array([record["gradient_error_wide"] for record in records])
    ours = [record["strategies"]["avo"] for record in records]
    wall, cpu = (np.array([entry[key] for entry in ours]) for key in ("wall_s", "cpu_s"))
    inside = sum(len(entry["in_wall"]) for entry in ours)
    more = " and ".join(
        f"`{other}` of {sum(r['strategies']['avo']['union'] > r['strategies'][other]['union'] for r in records)}"
        for other in _OTHERS[:2]
    )
    orbit = [record["strategies"]["canonical"] for record in records]
    beside_free = sum(mine["union"] > other["union_free"] for mine, other in zip(ours, orbit))
    far = sum(mine["union"] > other["union_free"] + TIE for mine, other in zip(ours, orbit))
    machines = sorted({machine_line(one["machine"]) for one in kept})
    seconds = [
        f"{np.median(v):.1f} s (median), {np.percentile(v, 90):.1f} s (90th percentile), {v.max():.1f} s (most)"
        for v in (cpu, wall)
    ]
    return [
        f"- By any difference, however small, four views of `avo` see more than {more} of {len(records)} objects.",
        f"- Of the cameras of `canonical`, which knows nothing of the room, {sum(o['free'] for o in orbit)} of "
        f"{sum(o['views'] for o in orbit)} stand in free space that frames looked through. With these alone it sees "
        f"{100 * np.mean([o['union_free'] for o in orbit]):.1f} %; `avo` sees more of {beside_free} of {len(records)} "
        f"objects, of {far} by more than a tie.",
        "- Pose gradient beside central differences, at the input camera nearest to each object: median "
        f"{100 * np.median(errors):.1f} %, {100 * (errors <= 0.03).mean():.0f} % of the objects within 3 %, worst "
        f"{100 * errors.max():.1f} %, median of differences over 0.01 to 1 µm and µrad; over 0.3 to 1 mm, in which "
        f"Gaussians change their order, median {100 * np.median(wide):.1f} %, worst {100 * wide.max():.0f} %.",
        f"- Cameras of `avo` inside a thing, behind a wall or below the floor: {inside} of "
        f"{sum(entry['views'] for entry in ours)}.",
        f"- An object with four views, pictures included: processor time {seconds[0]}; wall time {seconds[1]}. Once a "
        f"scene: {np.median([one['prepared_s'] for one in kept]):.1f} s.",
        f"- Measured on {'; '.join(machines)}; commits {', '.join(sorted({one['commit'] for one in kept}))}.",
    ]
