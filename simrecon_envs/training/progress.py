"""`Progress`: one status line, overwritten on a terminal; a line every 15 s elsewhere."""

import sys
import time
from collections import deque
from typing import TextIO

_TERMINAL_EVERY_S = 0.5
_LOG_EVERY_S = 15.0
_RATE_OVER_S = 30.0


class Interrupted(Exception):
    """Training stopped between two updates on request; a checkpoint was saved."""


class Progress:
    """Shows progress, speed, success rate and remaining time of a run."""

    def __init__(self, total: int, *, quiet: bool = False, stream: TextIO | None = None) -> None:
        """Begin a run of `total` steps."""
        self._stream = stream if stream is not None else sys.stderr
        self._quiet = quiet
        self._terminal = self._stream.isatty()
        self._total = total
        self._marks: deque[tuple[float, int]] = deque()  # (time, steps) of the last half minute
        self._shown = 0.0
        self._width = 0

    def training(self, steps: int, success: float | None) -> None:
        """Show the training status, if the last line is old enough."""
        if self._quiet:
            return
        now = time.perf_counter()
        if not self._marks:
            self._marks.append((now, steps))
            self._shown = now
            return
        if now - self._shown < (_TERMINAL_EVERY_S if self._terminal else _LOG_EVERY_S):
            return
        self._shown = now
        self._marks.append((now, steps))
        while len(self._marks) > 2 and now - self._marks[0][0] > _RATE_OVER_S:
            self._marks.popleft()
        rate = (steps - self._marks[0][1]) / max(now - self._marks[0][0], 1e-6)
        left = _clock((self._total - steps) / rate) if rate > 0 else "?"
        done = "no episode has ended yet" if success is None else f"success {success:4.0%}"
        share = steps / self._total
        self._write(
            f"{share:4.0%}  {steps:,} of {self._total:,} steps, {rate:,.0f} steps/s, {done}, {left} left"
        )

    def evaluating(self, done: int, total: int, successes: int) -> None:
        """Show the evaluation status, if the last line is old enough."""
        now = time.perf_counter()
        if self._quiet or now - self._shown < (_TERMINAL_EVERY_S if self._terminal else _LOG_EVERY_S):
            return
        self._shown = now
        self._write(f"evaluating: {done} of {total} episodes, {successes} succeeded")

    def say(self, text: str) -> None:
        """Write a permanent line."""
        if not self._quiet:
            self.clear()
            self._stream.write(text + "\n")
            self._stream.flush()

    def clear(self) -> None:
        """Erase the status line."""
        if self._width:
            self._stream.write("\r" + " " * self._width + "\r")
            self._width = 0

    def _write(self, line: str) -> None:
        if self._terminal:
            self._stream.write("\r" + line.ljust(self._width))
            self._width = len(line)
        else:
            self._stream.write(line + "\n")
        self._stream.flush()


def _clock(seconds: float) -> str:
    whole = round(seconds)
    return (
        f"{whole // 3600}:{whole // 60 % 60:02}:{whole % 60:02}"
        if whole >= 3600
        else f"{whole // 60}:{whole % 60:02}"
    )
