"""A task of a scene by kind, name and object ids, independent of any robot placement."""

from dataclasses import dataclass

THEN = "-then-"  # joins the stages of a composite task's name


@dataclass(frozen=True)
class TaskSpec:
    """A task of a scene."""

    kind: str
    name: str
    subject: int | None = None  # id of the object that is moved, reached or driven to
    place: int | None = None  # id of the object or surface that it is moved to
    problems: tuple[str, ...] = ()  # reasons why it is likely infeasible; empty: none known
    stages: tuple["TaskSpec", ...] = ()  # of a composite

    @property
    def feasible(self) -> bool:
        """Return whether the bundle gives no reason against it."""
        return not self.problems

    @property
    def subject_id(self) -> int:
        """Return the subject of a kind that has one."""
        assert self.subject is not None
        return self.subject

    @property
    def place_id(self) -> int:
        """Return the place of a kind that has one."""
        assert self.place is not None
        return self.place
