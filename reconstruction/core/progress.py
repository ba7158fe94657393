"""Interfaces of progress reporting: stages call them, the command line displays them."""

from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from reconstruction.core.profiling import Usage


class Progress(Protocol):
    """A sink for the progress of a stage."""

    def start(self, total: int, label: str) -> None:
        """Begin a step of `total` units within the stage."""

    def advance(self, n: int = 1) -> None:
        """Report `n` more units as done."""

    def note(self, message: str) -> None:
        """Report one line to the user: a decision, a fallback, dropped data."""


class StageListener(Progress, Protocol):
    """A progress sink that also receives the begin and end of stages."""

    def begin_stage(self, name: str, number: int, total: int, cached: bool) -> None:
        """Report the begin of a stage, or that it is taken from the cache."""

    def end_stage(self, name: str, usage: "Usage | None") -> None:
        """Report the end of a stage; `usage` is None if it came from the cache."""


class NoProgress:
    """Discards everything."""

    def begin_stage(self, name: str, number: int, total: int, cached: bool) -> None:
        """See `StageListener.begin_stage`."""

    def end_stage(self, name: str, usage: "Usage | None") -> None:
        """See `StageListener.end_stage`."""

    def start(self, total: int, label: str) -> None:
        """See `Progress.start`."""

    def advance(self, n: int = 1) -> None:
        """See `Progress.advance`."""

    def note(self, message: str) -> None:
        """See `Progress.note`."""


NO_PROGRESS = NoProgress()
