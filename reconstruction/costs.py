"""Time and memory of each step of a run: the report of a bundle in, text or JSON out."""

from dataclasses import asdict, dataclass

from reconstruction.pipeline import STAGE_NAMES

PUBLISH = "publish"  # writing the bundle
OTHER = "other"  # the rest of the run: hashing the input, saving and loading results


@dataclass(frozen=True)
class CostRow:
    """Time and memory of one step; None where not measured."""

    name: str
    wall_s: float
    cpu_s: float | None
    peak_memory_mb: float | None
    cached: bool

    @property
    def cores(self) -> float | None:
        """Mean number of busy cores; None where it cannot be told."""
        return None if self.cpu_s is None or self.wall_s < 0.05 else self.cpu_s / self.wall_s


def cost_rows(report: dict) -> list[CostRow]:
    """Return the cost of each step, in the order in which they ran.

    Args:
        report: `report` of a `scene.json`; those of earlier versions lack some figures.
    """
    times, volatile = report.get("timings_s", {}), report.get("volatile", {})
    order = [*STAGE_NAMES, PUBLISH, OTHER]
    names = sorted(times, key=lambda name: order.index(name) if name in order else len(order))
    return [
        CostRow(
            name,
            times[name],
            volatile.get("cpu_s", {}).get(name),
            volatile.get("stage_peak_memory_mb", {}).get(name),
            name in volatile.get("cached", ()),
        )
        for name in names
    ]


def describe_costs(report: dict) -> str:
    """Return the costs as a text table with a row of totals."""
    rows = cost_rows(report)
    total = CostRow(
        "total",
        sum(row.wall_s for row in rows),
        sum(row.cpu_s for row in rows if row.cpu_s is not None) if any(row.cpu_s for row in rows) else None,
        report.get("peak_memory_mb"),
        False,
    )
    lines = [f"{'stage':<12}{'wall s':>9}{'CPU s':>9}{'cores':>7}{'peak GB':>9}"]
    for row in [*rows, total]:
        peak = None if row.peak_memory_mb is None else row.peak_memory_mb / 1024
        lines.append(
            f"{row.name:<12}{row.wall_s:>9.1f}{_shown(row.cpu_s):>9}{_shown(row.cores):>7}{_shown(peak, 2):>9}"
            f"{'  from the cache' if row.cached else ''}"
        )
    return "\n".join(line.rstrip() for line in lines)


def costs_json(report: dict) -> dict[str, dict]:
    """Return the costs as JSON: step -> wall_s, cpu_s, peak_memory_mb, cached."""
    rows = [asdict(row) for row in cost_rows(report)]
    return {row.pop("name"): row for row in rows}


def _shown(value: float | None, digits: int = 1) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
