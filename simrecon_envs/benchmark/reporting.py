"""`Reporter`: progress messages with the estimated time left."""

import sys
import time


class Reporter:
    """Writes lines to standard error, or nothing if `quiet`."""

    def __init__(self, quiet: bool = False) -> None:
        """Start the clock."""
        self._quiet = quiet
        self._total = self._done = 0
        self._began = time.monotonic()

    def start(self, total: int, label: str) -> None:
        """Begin a job of `total` parts; 0: unknown."""
        self._total, self._done, self._began = total, 0, time.monotonic()
        self.note(label)

    def done(self, text: str) -> None:
        """Report a finished part."""
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
