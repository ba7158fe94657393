"""Progress reporting as an argument: stages call it, only the command line shows it."""

from typing import Protocol


class Progress(Protocol):
    """What a stage may report while it works."""

    def start(self, total: int, label: str) -> None:
        """Begin a step of `total` units within the stage."""

    def advance(self, n: int = 1) -> None:
        """`n` units are done."""

    def note(self, message: str) -> None:
        """One line worth telling the user: a decision, a fallback, something dropped."""


class NoProgress:
    """Discards everything."""

    def start(self, total: int, label: str) -> None:
        """See `Progress.start`."""

    def advance(self, n: int = 1) -> None:
        """See `Progress.advance`."""

    def note(self, message: str) -> None:
        """See `Progress.note`."""


NO_PROGRESS = NoProgress()
