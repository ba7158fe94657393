"""What is kept of one run: a JSON file for each capture and variant."""

import json
import os
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Literal

from registry.errors import UsageError

SCHEMA = "simrecon.benchmark/1"
_GROUPS = {  # as `left_out` of an evaluation names them
    "cameras": ("ate_cm", "scale_error", "tilt_deg"),
    "geometry": ("cd_cm", "f_5cm", "nc"),
    "objects": ("object_",),
    "graph": ("graph_",),
    "outlines": ("outline_",),
}
Status = Literal["done", "reconstruct failed", "evaluate failed"]


@dataclass(frozen=True)
class Result:
    """One variant on one capture: its figures, or why there are none; and where and with what they were made."""

    capture: str
    truth: str
    variant: str
    arguments: list[str]
    meaning: str
    status: Status
    exit_code: int
    error: str  # the last lines that the failed command wrote
    commit: str
    dirty: bool
    date: str  # UTC, ISO 8601
    machine: dict
    load_before: float  # 1-minute load average: other programs slow a run down
    inputs: str  # digest of what went in
    sources: str  # digest of the code
    wall_s: dict[str, float] = field(default_factory=dict)  # of this run's commands, cached stages included
    report: dict = field(default_factory=dict)  # of the bundle: timings, memory, registration, notes
    objects: int | None = None
    evaluation: dict = field(default_factory=dict)  # what `simrecon evaluate --json` wrote

    @property
    def failed(self) -> bool:
        """Whether there are no figures."""
        return self.status != "done"

    @property
    def metrics(self) -> dict[str, float | None]:
        """The figures by name; time and memory are the bundle's own where the evaluation does not repeat them."""
        found = dict(self.evaluation.get("metrics", {})) | _flat_numbers(
            "stages", self.evaluation.get("stages", {})
        )
        timings = self.report.get("timings_s", {})
        # What the stages cost when they were computed, also where this run took them from the cache.
        if timings:
            found["time_s"] = sum(timings.values())
        if self.report.get("peak_memory_mb") is not None:
            found["peak_memory_mb"] = self.report["peak_memory_mb"]
        registration = self.report.get("registration", {})
        if registration.get("keyframes"):
            found["registered_share"] = registration["registered"] / registration["keyframes"]
        if self.objects is not None:
            found["objects"] = self.objects
        return found

    def reason(self, metric: str) -> str:
        """Say why a figure is missing."""
        if self.failed:
            return f"{self.status}, exit code {self.exit_code}: {last_line(self.error)}"
        left_out = self.evaluation.get("left_out", {})
        # The evaluation names the figure, its stage, or the whole group that it belongs to.
        stage = f"stage {metric.split('.')[1]}" if metric.startswith("stages.") else ""
        group = next((name for name, keys in _GROUPS.items() if metric.startswith(keys)), "")
        for key, reason in left_out.items():
            if key in (metric, stage) or (group and group in key.split(", ")):
                return str(reason)
        return f"the evaluation has no {stage or metric}"


def _flat_numbers(prefix: str, tree: dict) -> dict[str, float | None]:
    """Return the numbers of nested dictionaries by dotted name."""
    found: dict[str, float | None] = {}
    for key, value in tree.items():
        if isinstance(value, dict):
            found |= _flat_numbers(f"{prefix}.{key}", value)
        elif isinstance(value, (int, float)):
            found[f"{prefix}.{key}"] = value
    return found


def last_line(text: str) -> str:
    """Return the last line that says something."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    return lines[-1] if lines else "(it wrote nothing)"


def result_path(out: Path, capture: str, variant: str) -> Path:
    """Return where a result is kept."""
    return out / capture / f"{variant}.json"


def save_result(result: Result, out: Path) -> Path:
    """Write a result whole or not at all."""
    path = result_path(out, result.capture, result.variant)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_suffix(f".{os.getpid()}.partial")
    partial.write_text(json.dumps({"schema": SCHEMA, **asdict(result)}, indent=1) + "\n")
    partial.replace(path)
    return path


def load_result(path: Path) -> Result:
    """Read a result; keys that this version does not know are ignored.

    Raises:
        UsageError: the file is no result.
    """
    try:
        data = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise UsageError(f"{path}: not a benchmark result ({error}); delete it and run again") from error
    if not isinstance(data, dict) or data.get("schema") != SCHEMA:
        raise UsageError(f"{path}: not a benchmark result of schema {SCHEMA}; delete it and run again")
    known = Result.__dataclass_fields__
    try:
        return Result(**{key: value for key, value in data.items() if key in known})
    except TypeError as error:
        raise UsageError(
            f"{path}: an incomplete benchmark result ({error}); delete it and run again"
        ) from error


def load_results(out: Path) -> list[Result]:
    """Read all results below a folder, by capture and variant."""
    return [load_result(path) for path in sorted(out.glob("*/*.json"))]
