"""Write docs/benchmarks.md from the results of `python -m benchmarks.run`.

python -m benchmarks.table [--out DIR] [--page FILE]
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from string import Template

from benchmarks.columns import GROUPS, ORACLE, OUTLINES, PAPER, PAPER_ROWS, REAL, Column
from benchmarks.machine import ROOT, describe_code, machine_line
from benchmarks.results import Result, last_line, load_results
from benchmarks.spread import PooledResult, Spread, pool, save_spreads, spread_of
from benchmarks.variants import BASELINE, VARIANTS, is_oracle
from reconstruction.costs import cost_rows
from registry.errors import SimReconError, UsageError

DEFAULT_OUT = ROOT / "benchmarks" / "out"
DEFAULT_PAGE = ROOT / "docs" / "benchmarks.md"
_TEMPLATE = Path(__file__).with_name("page.md.in")
_NOTHING = "Not measured yet."


@dataclass
class Notes:
    """Numbered explanations below a table; equal ones share a number."""

    texts: list[str] = field(default_factory=list)

    def mark(self, text: str) -> str:
        """Return the mark of an explanation."""
        if text not in self.texts:
            self.texts.append(text)
        return f"<sup>{self.texts.index(text) + 1}</sup>"

    def lines(self) -> list[str]:
        """Return the explanations as a list under the table."""
        return (
            ["", *(f"<sup>{n}</sup> {text}  " for n, text in enumerate(self.texts, start=1))]
            if self.texts
            else []
        )


def write_page(results: Sequence[Result], page: Path, code: dict) -> None:
    """Write the page with all tables.

    Args:
        results: of every run to show.
        page: the file to write.
        code: of the working tree (`describe_code`); results of other sources are marked.
    """
    text = render_page(results, code)
    page.parent.mkdir(parents=True, exist_ok=True)
    page.write_text(text)


def render_page(results: Sequence[Result], code: dict) -> str:
    """Return the page's Markdown."""
    results = sorted(pool(results), key=_order)
    keys = {id(result): f"r{number}" for number, result in enumerate(results, start=1)}
    full = [result for result in results if result.truth == "scene"]
    real = [result for result in results if result.truth != "scene"]
    labelled = {r.capture for r in results if r.metrics.get(OUTLINES[0].key) is not None}
    outlined = [result for result in results if result.capture in labelled]
    stale = sum(result.sources != code["sources"] for result in results)
    state = f"{stale} of {len(results)} runs are of an older state of the code and marked †." if stale else ""
    counts = sorted({len(result.runs) for result in results if isinstance(result, PooledResult)})
    if counts:
        state += (
            f" Cells with ± are mean ± standard deviation of {' or '.join(map(str, counts))} runs that differ in the "
            "last bits of their depth maps."
        )
    return Template(_TEMPLATE.read_text()).substitute(
        state=state.strip(),
        baseline=BASELINE,
        means=_means(full) if full else _NOTHING,
        paper=_paper(),
        oracles=_oracles(full) or _NOTHING,
        captures=_captures(full, keys) or _NOTHING,
        times=_times(results) or _NOTHING,
        outlines=_rows(outlined, OUTLINES, keys, with_capture=True) if outlined else _NOTHING,
        real=_rows(real, REAL, keys, with_capture=True) if real else _NOTHING,
        runs=_runs(results, keys, code) if results else _NOTHING,
    )


def _order(result: Result) -> tuple:
    names = [variant.name for variant in VARIANTS]
    known = names.index(result.variant) if result.variant in names else len(names)
    return (result.capture, known, result.variant)


def _variant_names(results: Sequence[Result]) -> list[str]:
    """Return the variants in the order of VARIANTS, ad hoc ones last."""
    return list(dict.fromkeys(result.variant for result in sorted(results, key=lambda r: _order(r)[1:])))


def table_lines(heads: Sequence[str], rows: Sequence[Sequence[str]], texts: int) -> list[str]:
    """Lay out a Markdown table whose first `texts` columns are text and the others numbers."""
    align = ["---"] * texts + ["---:"] * (len(heads) - texts)
    lines = [heads, align, *rows]
    return ["| " + " | ".join(cell.strip() for cell in line) + " |" for line in lines]


def _measured(columns: Sequence[Column], results: Sequence[Result]) -> list[Column]:
    """Leave out stages that no run had (a pipeline need not have all of them); other figures stay, missing or not."""
    found = {key for result in results for key in result.metrics}
    return [column for column in columns if not column.key.startswith("stages.") or column.key in found]


# -- Means over captures -------------------------------------------------------------------------------------------


def mean_of(results: Sequence[Result], key: str) -> tuple[float | None, int]:
    """Return the mean of a figure over captures, and over how many it is.

    A run that failed found nothing: it counts as recall 0. All other figures are over the runs that have them.
    """
    values = []
    for result in results:
        value = result.metrics.get(key)
        if result.failed and key.startswith("object_recall"):
            value = 0.0
        if value is not None:
            values.append(float(value))
    return (sum(values) / len(values), len(values)) if values else (None, 0)


def _means(results: Sequence[Result]) -> str:
    captures = sorted({result.capture for result in results})
    parts = [f"{len(captures)} captures: {', '.join(captures)}."]
    for title, every in GROUPS:
        columns, notes, rows = _measured(every, results), Notes(), []
        for name in _variant_names(results):
            group = [result for result in results if result.variant == name]
            done = sum(not result.failed for result in group)
            cells = [name, f"{done} of {len(group)}" + _missing_captures(group, captures, notes)]
            cells += [_mean_cell(group, column, done, notes) for column in columns]
            rows.append(cells)
        heads = ["variant", "captures done", *(column.head for column in columns)]
        parts += ["", f"### {title}", "", *table_lines(heads, rows, 2), *notes.lines()]
    return "\n".join(parts)


def _missing_captures(group: Sequence[Result], captures: Sequence[str], notes: Notes) -> str:
    missing = [name for name in captures if name not in {result.capture for result in group}]
    return notes.mark(f"not run on {', '.join(missing)}: compare with care") if missing else ""


def _mean_cell(group: Sequence[Result], column: Column, done: int, notes: Notes) -> str:
    mean, count = mean_of(group, column.key)
    if mean is None:
        reasons = sorted({result.reason(column.key) for result in group})
        return "–" + notes.mark(_flat("; ".join(reasons)))
    if count < done:
        without = [r.capture for r in group if not r.failed and r.metrics.get(column.key) is None]
        return column.shown(mean) + notes.mark(f"without {', '.join(without)}, which have no such figure")
    return column.shown(mean) + _plus_minus(_spread_of_means(group, column.key), column)


def _spread_of_means(group: Sequence[Result], key: str) -> Spread | None:
    """Return how the mean over captures varies from run to run; None unless all captures ran equally often."""
    runs = [result.runs if isinstance(result, PooledResult) else (result,) for result in group]
    if len({len(of) for of in runs}) != 1:
        return None
    return spread_of([mean_of(same, key)[0] for same in zip(*runs)])


def _plus_minus(spread: Spread | None, column: Column) -> str:
    """Return ± standard deviation as the column shows it, nothing where there was one run."""
    return f" ± {column.shown(spread.sd)}" if spread is not None and spread.runs > 1 else ""


# -- The paper -----------------------------------------------------------------------------------------------------


def _paper() -> str:
    # Time is a wall time as ours is; the others are defined in other ways.
    heads = ["method (ScanNet, RTX A6000)"]
    heads += [column.head + ("" if column.key == "time_s" else " *") for column in PAPER]
    rows = [[name, *(column.shown(values[column.key]) for column in PAPER)] for name, values in PAPER_ROWS]
    return "\n".join(table_lines(heads, rows, 1))


# -- Oracles -------------------------------------------------------------------------------------------------------


def _oracles(results: Sequence[Result]) -> str:
    base = {result.capture: result for result in results if result.variant == BASELINE}
    notes, rows = Notes(), []
    for name in (name for name in _variant_names(results) if is_oracle(name)):
        group = [result for result in results if result.variant == name and result.capture in base]
        if not group:
            continue
        cells = [name, f"{len(group)}"]
        for column in ORACLE:
            pairs = [(r, base[r.capture]) for r in group]
            differences = [
                a.metrics[column.key] - b.metrics[column.key]
                for a, b in pairs
                if a.metrics.get(column.key) is not None and b.metrics.get(column.key) is not None
            ]
            cells.append(_difference(differences, pairs, column, notes))
        rows.append(cells)
    if not rows:
        return ""
    base_runs = [result for result in base.values() if not result.failed]
    first = [f"{BASELINE} (absolute)", f"{len(base_runs)}"]
    first += [_mean_cell(base_runs, column, len(base_runs), notes) for column in ORACLE] if base_runs else []
    heads = ["variant", "captures", *(column.head for column in ORACLE)]
    return "\n".join(table_lines(heads, [first, *rows] if base_runs else rows, 2) + notes.lines())


def _difference(
    differences: Sequence[float], pairs: Sequence[tuple[Result, Result]], column: Column, notes: Notes
) -> str:
    if not differences:
        reasons = sorted(
            {r.reason(column.key) for pair in pairs for r in pair if r.metrics.get(column.key) is None}
        )
        return "–" + notes.mark(_flat("; ".join(reasons)))
    text = f"{sum(differences) / len(differences) * column.factor:+.{column.digits}f}"
    if len(differences) < len(pairs):
        text += notes.mark(f"over {len(differences)} of {len(pairs)} captures: the others lack the figure")
    return text


# -- Time by stage -----------------------------------------------------------------------------------------------


def _times(results: Sequence[Result]) -> str:
    """Mean wall seconds of each step over the captures of a variant, in the order in which they run."""
    done = [result for result in results if result.report.get("timings_s")]
    every = {"timings_s": {step: 0.0 for result in done for step in result.report["timings_s"]}}
    steps = [row.name for row in cost_rows(every)]
    rows = []
    for name in _variant_names(done):
        group = [result.report["timings_s"] for result in done if result.variant == name]
        means = [sum(times.get(step, 0.0) for times in group) / len(group) for step in steps]
        rows.append([name, f"{len(group)}", *(f"{mean:.1f}" for mean in means), f"{sum(means):.0f}"])
    return "\n".join(table_lines(["variant", "captures", *steps, "total"], rows, 2)) if rows else ""


# -- Capture by capture --------------------------------------------------------------------------------------------


def _captures(results: Sequence[Result], keys: dict[int, str]) -> str:
    parts: list[str] = []
    for name in sorted({result.capture for result in results}):
        group = [result for result in results if result.capture == name]
        parts += ["", f"### {name}"] if parts else [f"### {name}"]
        for title, columns in GROUPS:
            table = _rows(group, _measured(columns, results), keys, with_capture=False)
            parts += ["", f"{title}:", "", table]
    return "\n".join(parts)


def _rows(
    results: Sequence[Result], columns: Sequence[Column], keys: dict[int, str], *, with_capture: bool
) -> str:
    notes, rows = Notes(), []
    for result in results:
        first = [result.capture] if with_capture else []
        label = result.variant + (notes.mark(_flat(result.reason(""))) if result.failed else "")
        lost = [run for run in result.runs if run.failed] if isinstance(result, PooledResult) else []
        if lost and not result.failed:
            label += notes.mark(
                _flat(f"{len(lost)} of {len(result.runs)} runs failed: {last_line(lost[0].error)}")
            )
        cells = [*first, label, keys[id(result)]]
        rows.append(cells + _cells(result, columns, notes))
    heads = [*(["capture"] if with_capture else []), "variant", "run", *(column.head for column in columns)]
    return "\n".join(table_lines(heads, rows, 3 if with_capture else 2) + notes.lines())


def _cells(result: Result, columns: Sequence[Column], notes: Notes) -> list[str]:
    if result.failed:
        return ["failed", *("–" for _ in columns[1:])]
    cells = []
    for column in columns:
        value = result.metrics.get(column.key)
        if value is None:
            cells.append("–" + notes.mark(_flat(result.reason(column.key))))
            continue
        spread = result.spread(column.key) if isinstance(result, PooledResult) else None
        cells.append(column.shown(float(value)) + _plus_minus(spread, column))
    return cells


# -- Runs ----------------------------------------------------------------------------------------------------------


def _runs(results: Sequence[Result], keys: dict[int, str], code: dict) -> str:
    machines = list(dict.fromkeys(machine_line(result.machine) for result in results))
    lines = [f"- **machine {number}**: {line}" for number, line in enumerate(machines, start=1)]
    heads = ["run", "capture", "variant", "machine", "commit", "date (UTC)", "load before"]
    rows = [
        [
            keys[id(result)],
            result.capture,
            result.variant + (f", {len(result.runs)} runs" if isinstance(result, PooledResult) else ""),
            str(machines.index(machine_line(result.machine)) + 1),
            result.commit
            + (" + changes" if result.dirty else "")
            + (" †" if result.sources != code["sources"] else ""),
            result.date[:16].replace("T", " "),
            f"{result.load_before:.1f}",
        ]
        for result in results
    ]
    return "\n".join([*lines, "", *table_lines(heads, rows, 6), "", *_meanings(results)])


def _meanings(results: Sequence[Result]) -> list[str]:
    meanings: dict[str, str] = {result.variant: result.meaning for result in results}
    return ["Variants: " + "; ".join(f"**{n}** {meanings[n]}" for n in _variant_names(results)) + "."]


def _flat(text: str) -> str:
    """Make a reason fit into one line of Markdown."""
    return " ".join(text.split()).replace("|", "\\|").replace("<", "&lt;")


def main(argv: Sequence[str] | None = None) -> int:
    """Write the page from the results that are there."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.table", description=__doc__)
    parser.add_argument("--out", type=Path, default=DEFAULT_OUT, metavar="DIR", help="where results are kept")
    parser.add_argument("--page", type=Path, default=DEFAULT_PAGE, metavar="FILE", help="the page to write")
    arguments = parser.parse_args(argv)
    try:
        results = load_results(arguments.out)
        if not results:
            raise UsageError(f"{arguments.out}: no results; make some with python -m benchmarks.run")
        save_spreads(results, arguments.out)
        write_page(results, arguments.page, describe_code())
    except SimReconError as error:
        print(f"benchmarks: {error}", file=sys.stderr)
        return error.exit_code
    print(f"{arguments.page}: {len(results)} runs")
    return 0


if __name__ == "__main__":
    sys.exit(main())
