"""Table of costs: the report of a bundle in, time and memory of each step out, as text or JSON."""

from dataclasses import dataclass

from reconstruction.pipeline import STAGE_NAMES

PUBLISH = "publish"  # writing the bundle
OTHER = "other"  # the rest of the run: digesting the input, saving and loading what stages made


@dataclass(frozen=True)
class CostRow:
    """Time and memory of one step of a run; None where not measured."""

    name: str
    wall_s: float
    cpu_s: float | None
    peak_memory_mb: float | None
    cached: bool

    @property
    def cores(self) -> float | None:
        """How many cores were busy on average."""
        return None if self.cpu_s is None or self.wall_s < 0.05 else self.cpu_s / self.wall_s


def cost_rows(report: dict) -> list[CostRow]:
    """Read what each step cost from a bundle's `report`, in the order in which the steps ran.

    Args:
        report: the `report` of a `scene.json`, also of one that was written by an earlier version.
    """
    times, volatile = report["timings_s"], report.get("volatile", {})
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
    """Lay out what each step cost as a table for people, with the total below."""
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
    """Return the same figures for programs: step -> wall_s, cpu_s, peak_memory_mb, cached."""
    return {
        row.name: {
            "wall_s": row.wall_s,
            "cpu_s": row.cpu_s,
            "peak_memory_mb": row.peak_memory_mb,
            "cached": row.cached,
        }
        for row in cost_rows(report)
    }


def _shown(value: float | None, digits: int = 1) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
