"""Where the time of a reconstruction goes: wall and processor time of every step of every stage.

    python -m benchmarks.steps room.mp4                                   # everything, from the start
    python -m benchmarks.steps room.mp4 --stages depth assets --work-dir runs/steps --rounds 3

With `--stages` only these are computed anew; what they read comes from the work folder, or is computed there first.
Steps are those that the stages report as progress; of several rounds the median is printed. Run it on a quiet machine,
with compiled kernels (`simrecon doctor --warm`).
"""

import argparse
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

from benchmarks.command import guarded
from benchmarks.instances import stage_run
from benchmarks.machine import describe_machine
from reconstruction.core.profiling import Usage, UsageMeter
from reconstruction.core.progress import NoProgress
from reconstruction.pipeline import STAGES, Call, Stage
from reconstruction.runner import Run

_SHORT_S = 0.05  # shorter steps are left out of the table


@dataclass(frozen=True)
class Step:
    """A step of a stage and its cost; the same label may come several times."""

    stage: str
    label: str
    usage: Usage


class StepClock(NoProgress):
    """A progress sink that measures the time from each step to the next."""

    def __init__(self) -> None:
        self.steps: list[Step] = []
        self._stage, self._label = "", ""
        self._meter: UsageMeter | None = None

    def start(self, total: int, label: str) -> None:
        """End the former step, and begin another."""
        self._end()
        self._label = label
        self._meter = UsageMeter().__enter__()

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Measure the steps of a stage."""
        self._stage = name
        self.start(0, "(before the first step)")
        try:
            yield
        finally:
            self._end()

    def _end(self) -> None:
        if self._meter is not None:
            self._meter.__exit__()
            self.steps.append(Step(self._stage, self._label, self._meter.usage))
            self._meter = None


def measure_stage(run: Run, stage: Stage, clock: StepClock) -> Any:
    """Compute one stage anew from the results of a run, without the stage cache; return its result."""
    with tempfile.TemporaryDirectory() as folder:
        scratch, kept = Path(folder, "scratch"), Path(folder, "kept")
        scratch.mkdir()
        kept.mkdir()
        with clock.stage(stage.name):
            return stage.make(Call(run.video, run.options_of(stage), run.results, scratch, kept, clock))


def table_of(rounds: Sequence[Sequence[Step]]) -> list[str]:
    """Return the lines of a Markdown table: the median of each step over rounds with the same steps."""
    lines = ["| stage | step | wall s | processor s | cores |", "| --- | --- | ---: | ---: | ---: |"]
    for same in zip(*rounds, strict=True):
        wall, cpu = (median(getattr(step.usage, name) for step in same) for name in ("wall_s", "cpu_s"))
        if wall >= _SHORT_S:
            lines.append(f"| {same[0].stage} | {same[0].label} | {wall:.1f} | {cpu:.1f} | {cpu / wall:.1f} |")
    names = list(dict.fromkeys(step.stage for step in rounds[0]))
    for name in names:
        wall, cpu = (
            median(sum(getattr(s.usage, field) for s in steps if s.stage == name) for steps in rounds)
            for field in ("wall_s", "cpu_s")
        )
        lines.append(f"| {name} | **all** | {wall:.1f} | {cpu:.1f} | {cpu / max(wall, 1e-9):.1f} |")
    return lines


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command."""
    stages = [stage.name for stage in STAGES if not stage.on_demand]
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.steps",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("video", type=Path, help="a video or a folder of images")
    parser.add_argument(
        "--stages", nargs="+", choices=stages, default=stages, metavar="NAME", help=", ".join(stages)
    )
    parser.add_argument("--work-dir", type=Path, help="folder of the stage cache (default: a temporary one)")
    parser.add_argument("--rounds", type=int, default=1, help="measurements of each stage (default 1)")
    options, words = parser.parse_known_args(argv)
    return guarded(parser.prog, lambda: _measure(options, words))


def _measure(options: argparse.Namespace, words: Sequence[str]) -> int:
    with tempfile.TemporaryDirectory() as folder:
        run = stage_run(options.video, options.work_dir or Path(folder), words)
        clocks = [StepClock() for _ in range(max(options.rounds, 1))]
        for stage in (s for s in STAGES if s.name in options.stages):
            for name in run.needs_of(stage):
                if name not in run.results:
                    run.execute(name)
            made = [measure_stage(run, stage, clock) for clock in clocks]
            run.results[stage.name] = made[0]
    print(describe_machine())
    print("\n".join(table_of([clock.steps for clock in clocks])))
    return 0


if __name__ == "__main__":
    sys.exit(main())
