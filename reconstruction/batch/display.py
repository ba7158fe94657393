"""Show the progress of a batch: a live table on a terminal, one line for each event elsewhere."""

import sys
import time
from collections import deque
from collections.abc import Sequence
from contextlib import contextmanager, suppress
from typing import Any

from reconstruction.batch.attempt import Job, stage_of
from reconstruction.batch.driver import Counts
from reconstruction.batch.outcomes import Outcome, plain

_EVENTS, _ROWS = 6, 12
_REFRESH_S = 0.5


def duration(seconds: float) -> str:
    """Return a length of time in its two largest units, such as `2 h 10 min`."""
    seconds = round(seconds)
    if seconds < 60:
        return f"{seconds} s"
    minutes = round(seconds / 60)
    if minutes < 60:
        return f"{minutes} min"
    hours, minutes = divmod(minutes, 60)
    if hours < 48:
        return f"{hours} h {minutes} min" if minutes else f"{hours} h"
    days, hours = divmod(hours, 24)
    return f"{days} days {hours} h" if hours else f"{days} days"


def progress_text(counts: Counts) -> str:
    """Return the numbers in one line."""
    parts = [f"{counts.published} published"]
    if counts.failed:
        parts.append(f"{counts.failed} failed")
    parts += [f"{counts.running} running", f"{counts.waiting} waiting"]
    if counts.seconds_left is not None and counts.running + counts.waiting:
        parts.append(f"about {duration(counts.seconds_left)} left")
    return ", ".join(parts)


def ended_text(job: Job, outcome: Outcome, result: str) -> str:
    """Return an event in one line."""
    took = duration(outcome.wall_s)
    if result == "published":
        return f"{job.scene_id}: published in {took}"
    if result == "retry":
        return f"{job.scene_id}: {plain(outcome.cause)}; trying again (attempt {job.attempt + 1})"
    if result == "interrupted":
        return f"{job.scene_id}: interrupted; the next run continues it"
    return f"{job.scene_id}: FAILED: {plain(outcome.cause)}. {plain(outcome.cure)}"


class LineDisplay:
    """Prints one line for each event to standard error."""

    def __enter__(self) -> "LineDisplay":
        """Begin."""
        return self

    def __exit__(self, *exc: object) -> None:
        """End."""

    def started(self, job: Job, counts: Counts) -> None:
        """See `Display.started`."""
        again = f" (attempt {job.attempt})" if job.attempt > 1 else ""
        self.say(f"[{counts.ended}/{counts.total}] {job.scene_id}: started{again}")

    def ended(self, job: Job, outcome: Outcome, result: str, counts: Counts) -> None:
        """See `Display.ended`."""
        self.say(
            f"[{counts.ended}/{counts.total}] {ended_text(job, outcome, result)}; {progress_text(counts)}"
        )

    def tick(self, counts: Counts, running: Sequence[Job]) -> None:
        """See `Display.tick`."""

    def say(self, text: str) -> None:
        """See `Display.say`. A reader that has gone away does not end the batch."""
        with suppress(OSError, ValueError):
            sys.stderr.write(text + "\n")
            sys.stderr.flush()


class QuietDisplay(LineDisplay):
    """Shows nothing."""

    def say(self, text: str) -> None:
        """See `Display.say`."""


class TableDisplay(LineDisplay):
    """Shows a bar, the running videos with their stages, and the last events; for terminals."""

    def __init__(self) -> None:
        from rich.console import Console
        from rich.live import Live

        self._live: Any = Live(console=Console(stderr=True), auto_refresh=False)
        self._events: deque[str] = deque(maxlen=_EVENTS)
        self._since: dict[str, float] = {}
        self._shown = 0.0

    def __enter__(self) -> "TableDisplay":
        """Begin."""
        self._live.start()
        return self

    def __exit__(self, *exc: object) -> None:
        """End."""
        self._live.stop()

    def started(self, job: Job, counts: Counts) -> None:
        """See `Display.started`."""
        self._since[job.scene_id] = time.monotonic()

    def ended(self, job: Job, outcome: Outcome, result: str, counts: Counts) -> None:
        """See `Display.ended`."""
        if result == "published":
            self._events.append(ended_text(job, outcome, result))
        else:
            self.say(ended_text(job, outcome, result))

    def say(self, text: str) -> None:
        """See `Display.say`: the line stays above the table."""
        from rich.text import Text

        self._live.console.print(Text(text))

    def tick(self, counts: Counts, running: Sequence[Job]) -> None:
        """See `Display.tick`."""
        now = time.monotonic()
        if now - self._shown < _REFRESH_S and running:
            return
        self._shown = now
        self._live.update(self._picture(counts, running, now), refresh=True)

    def _picture(self, counts: Counts, running: Sequence[Job], now: float) -> Any:
        from rich.console import Group
        from rich.progress_bar import ProgressBar
        from rich.table import Table
        from rich.text import Text

        table = Table("scene", "stage", "attempt", "time", box=None, pad_edge=False, header_style="dim")
        for job in running[:_ROWS]:
            since = duration(now - self._since.get(job.scene_id, now))
            table.add_row(Text(job.scene_id), Text(stage_of(job.log) or "starting"), str(job.attempt), since)
        parts: list[Any] = [
            ProgressBar(total=max(1, counts.total), completed=counts.ended, width=60),
            Text(progress_text(counts)),
            table,
        ]
        if len(running) > _ROWS:
            parts.append(Text(f"and {len(running) - _ROWS} more running", style="dim"))
        return Group(*parts, *(Text(event, style="dim") for event in self._events))


@contextmanager
def make_display(quiet: bool):
    """Open the display for standard error: a table if it is a terminal and `rich` is there, else lines; or none."""
    made: LineDisplay = QuietDisplay() if quiet else LineDisplay()
    if not quiet and sys.stderr.isatty():
        with suppress(ImportError):
            made = TableDisplay()
    with made as display:
        yield display
