"""How a running reconstruction is shown: bars on a terminal, plain lines elsewhere, nothing when asked."""

import sys
import time

from tqdm import tqdm

from reconstruction.core.profiling import Usage
from reconstruction.core.progress import NoProgress

_LINE_EVERY_S = 15.0


class QuietListener(NoProgress):
    """Shows nothing; the others add what they show."""

    def __enter__(self) -> "QuietListener":
        """Begin."""
        return self

    def __exit__(self, *exc: object) -> None:
        """End."""


class LineListener(QuietListener):
    """One line when a stage begins and ends, and every 15 s within; for logs and pipes."""

    def begin_stage(self, name: str, number: int, total: int, cached: bool) -> None:
        """Say which stage begins."""
        self._label = f"[{number}/{total}] {name}"
        self._total = self._done = 0
        self._last = self._began = time.perf_counter()
        self._say(f"{self._label}: {'already done, reusing it' if cached else '...'}")

    def end_stage(self, name: str, usage: Usage | None) -> None:
        """Say what the stage cost."""
        if usage:
            self._say(f"{self._label}: {usage.wall_s:.1f} s, peak {usage.peak_memory_mb / 1024:.1f} GB")

    def start(self, total: int, label: str) -> None:
        """Begin a step."""
        self._step, self._total, self._done = label, total, 0
        self._began = time.perf_counter()

    def advance(self, n: int = 1) -> None:
        """Report now and then."""
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
    """A bar per step with the time left; for terminals."""

    _bar: tqdm | None = None

    def __exit__(self, *exc: object) -> None:
        """Leave the terminal clean."""
        self._close()

    def begin_stage(self, name: str, number: int, total: int, cached: bool) -> None:
        """Show the stage's name."""
        self._stage = f"[{number}/{total}] {name}"
        if cached:
            tqdm.write(f"{self._stage}: already done, reusing it", file=sys.stderr)
        else:
            self.start(0, "starting")

    def end_stage(self, name: str, usage: Usage | None) -> None:
        """Replace the bar with what the stage cost."""
        self._close()
        if usage:
            tqdm.write(
                f"{self._stage}: {usage.wall_s:.1f} s, peak {usage.peak_memory_mb / 1024:.1f} GB",
                file=sys.stderr,
            )

    def start(self, total: int, label: str) -> None:
        """Begin a step's bar."""
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
    """Choose how to show progress: nothing, bars on a terminal, lines elsewhere."""
    if quiet:
        return QuietListener()
    return BarListener() if sys.stderr.isatty() else LineListener()
