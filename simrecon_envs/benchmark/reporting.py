"""What a person sees while a suite is generated or run: a line a task, with the time left."""

import sys
import time


class Reporter:
    """Writes lines to standard error, or nothing."""

    def __init__(self, quiet: bool = False) -> None:
        self._quiet = quiet
        self._total = self._done = 0
        self._began = time.monotonic()

    def start(self, total: int, label: str) -> None:
        """Begin something of `total` parts; 0 where it is not known how many."""
        self._total, self._done, self._began = total, 0, time.monotonic()
        self.note(label)

    def done(self, text: str) -> None:
        """Say that a part is done."""
        self._done += 1
        if not self._total:
            return self.note(f"  [{self._done}] {text}")
        left = (time.monotonic() - self._began) / self._done * (self._total - self._done)
        return self.note(f"  [{self._done}/{self._total}, {left:.0f} s left] {text}")

    def note(self, text: str) -> None:
        """Write a line."""
        if not self._quiet:
            sys.stderr.write(text + "\n")
            sys.stderr.flush()
