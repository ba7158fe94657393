"""Display of progress: bars on a terminal, lines elsewhere, or nothing."""

import sys
import time

from tqdm import tqdm

from reconstruction.core.profiling import Usage
from reconstruction.core.progress import NoProgress

_LINE_EVERY_S = 15.0


class QuietListener(NoProgress):
    """Shows nothing; base of the others."""

    def __enter__(self) -> "QuietListener":
        """Begin."""
        return self

    def __exit__(self, *exc: object) -> None:
        """End."""


class LineListener(QuietListener):
    """Prints a line when a stage begins and ends, and every 15 s between; for logs and pipes."""

    def begin_stage(self, name: str, number: int, total: int, cached: bool) -> None:
        """Print the name of the stage."""
        self._label = f"[{number}/{total}] {name}"
        self._total = self._done = 0
        self._last = self._began = time.perf_counter()
        self._say(f"{self._label}: {'already done, reusing it' if cached else '...'}")

    def end_stage(self, name: str, usage: Usage | None) -> None:
        """Print the costs of the stage."""
        if usage:
            self._say(f"{self._label}: {_cost(usage)}")

    def start(self, total: int, label: str) -> None:
        """Begin a step."""
        self._step, self._total, self._done = label, total, 0
        self._began = time.perf_counter()

    def advance(self, n: int = 1) -> None:
        """Print progress every `_LINE_EVERY_S`."""
        self._done += n
        now = time.perf_counter()
        if now - self._last >= _LINE_EVERY_S and self._total:
            self._last = now
            left = (now - self._began) / max(self._done, 1) * (self._total - self._done)
            self._say(f"{self._label}: {self._step} {self._done}/{self._total}, about {left:.0f} s left")

    def note(self, message: str) -> None:
        """Print a note."""
        self._say(f"{self._label}: note: {message}")

    @staticmethod
    def _say(text: str) -> None:
        print(text, file=sys.stderr, flush=True)


class BarListener(QuietListener):
    """Shows a bar with the remaining time for each step; for terminals."""

    _bar: tqdm | None = None

    def __exit__(self, *exc: object) -> None:
        """Remove the bar."""
        self._close()

    def begin_stage(self, name: str, number: int, total: int, cached: bool) -> None:
        """Show the name of the stage."""
        self._stage = f"[{number}/{total}] {name}"
        if cached:
            tqdm.write(f"{self._stage}: already done, reusing it", file=sys.stderr)
        else:
            self.start(0, "starting")

    def end_stage(self, name: str, usage: Usage | None) -> None:
        """Replace the bar by the costs of the stage."""
        self._close()
        if usage:
            tqdm.write(f"{self._stage}: {_cost(usage)}", file=sys.stderr)

    def start(self, total: int, label: str) -> None:
        """Start the bar of a step."""
        self._close()
        layout = "{desc} {bar} {n_fmt}/{total_fmt} {remaining} left" if total else "{desc} {elapsed}"
        self._bar = tqdm(
            total=total or None,
            desc=f"{self._stage}: {label}",
            bar_format=layout,
            leave=False,
            file=sys.stderr,
        )

    def advance(self, n: int = 1) -> None:
        """Move the bar."""
        if self._bar is not None:
            self._bar.update(n)

    def note(self, message: str) -> None:
        """Print a note above the bar."""
        tqdm.write(f"{self._stage}: note: {message}", file=sys.stderr)

    def _close(self) -> None:
        if self._bar is not None:
            self._bar.close()
            self._bar = None


def make_listener(quiet: bool) -> QuietListener:
    """Return the listener for standard error: bars if it is a terminal, else lines; or none."""
    if quiet:
        return QuietListener()
    return BarListener() if sys.stderr.isatty() else LineListener()


def _cost(usage: Usage) -> str:
    return f"{usage.wall_s:.1f} s, peak {usage.peak_memory_mb / 1024:.1f} GB"
