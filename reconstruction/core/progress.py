"""Progress reporting as an argument: stages call it, only the command line shows it."""

from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from reconstruction.core.profiling import Usage


class Progress(Protocol):
    """What a stage may report while it works."""

    def start(self, total: int, label: str) -> None:
        """Begin a step of `total` units within the stage."""

    def advance(self, n: int = 1) -> None:
        """`n` units are done."""

    def note(self, message: str) -> None:
        """One line worth telling the user: a decision, a fallback, something dropped."""


class StageListener(Progress, Protocol):
    """A progress sink that is also told when stages begin and end."""

    def begin_stage(self, name: str, number: int, total: int, cached: bool) -> None:
        """A stage begins, or is taken from the cache."""

    def end_stage(self, name: str, usage: "Usage | None") -> None:
        """A stage is done; `usage` is None if it came from the cache."""


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
