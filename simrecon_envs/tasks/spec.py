"""A task of a scene by name, before any robot stands in it."""

from dataclasses import dataclass

THEN = "-then-"


@dataclass(frozen=True)
class TaskSpec:
    """A task in a scene, before any robot stands in it."""

    kind: str
    name: str
    subject: int | None = None  # what is moved, reached or driven to
    place: int | None = None  # where to
    problems: tuple[str, ...] = ()  # why it can hardly be done; empty where nothing speaks against it
    stages: tuple["TaskSpec", ...] = ()  # of a composite

    @property
    def feasible(self) -> bool:
        """Tell whether nothing speaks against it, as far as the bundle says."""
        return not self.problems
