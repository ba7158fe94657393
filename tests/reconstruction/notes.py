"""A watcher that keeps what stages say."""

from reconstruction.core.progress import NoProgress


class Notes(NoProgress):
    """Keeps notes, drops progress."""

    def __init__(self) -> None:
        self.notes: list[str] = []

    def note(self, message: str) -> None:
        self.notes.append(message)
