"""Interface of relation backends (a question in, a local graph out) and the records of merging."""

from collections.abc import Iterable
from dataclasses import dataclass, fields
from typing import Protocol

import numpy as np

from reconstruction.core.types import Edge, SceneGraph

RELATIONS = ("supported_by", "attached_to")


@dataclass(frozen=True)
class SaidEdge(Edge):
    """An edge and its source: "geometry", or the name of a model."""

    said_by: str = "geometry"


@dataclass(frozen=True)
class Question:
    """A question to a backend: the parents of the objects in a view."""

    about: tuple[int, ...]  # ids of the objects that the view is chosen for: a region, or a conflict
    visible: tuple[int, ...]  # ids of all objects to answer for, those of `about` included
    attempt: int = 0  # number of earlier questions about the same; each gets another view

    @classmethod
    def of(cls, about: Iterable[int], visible: Iterable[int] = (), attempt: int = 0) -> "Question":
        """Make a question with sorted ids."""
        about = set(about)
        return cls(tuple(sorted(about)), tuple(sorted(about | set(visible))), attempt)


@dataclass(frozen=True)
class LocalGraph:
    """The answer for a view: at most one parent for each visible object, no cycles."""

    edges: tuple[SaidEdge, ...]
    visible: tuple[int, ...]  # objects that the backend could see
    picture: np.ndarray | None = None  # uint8 (h, w, 3), if the backend was shown one
    notes: tuple[str, ...] = ()  # problems, for the user


class RelationBackend(Protocol):
    """Infers parents of the objects of a view: from geometry, by a vision-language model, ...

    Ids of an answer are in `Question.visible` or base, children are objects, no object has two parents or is its own
    ancestor. No edge means that nothing is known. Answers are deterministic.
    """

    name: str

    def infer(self, question: Question) -> LocalGraph:
        """Answer a question."""
        ...


@dataclass(frozen=True)
class Decision:
    """Outcome of merging one edge of a view into the scene graph, with its reason."""

    child: int
    relation: str
    parent: int
    verdict: str  # "new", "known", "redundant", "conflict", "kept", "replaced", "loose", "refused"
    why: str


@dataclass(frozen=True)
class MergeStep:
    """One step of merging: a view, its edges, and the graph after it."""

    kind: str  # "region", "adjudication", "rest", "fallback"
    about: tuple[int, ...]
    visible: tuple[int, ...]
    said: tuple[SaidEdge, ...]
    decisions: tuple[Decision, ...]
    merged: tuple[SaidEdge, ...]  # the global graph after this step
    picture: np.ndarray | None = None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class MergedGraph(SceneGraph):
    """The result of the stage: the scene graph with the source of each edge, and the steps of merging."""

    edges: tuple[SaidEdge, ...]
    steps: tuple[MergeStep, ...] = ()

    def plain(self) -> SceneGraph:
        """Return the graph without sources and steps."""
        names = [field.name for field in fields(Edge)]
        return SceneGraph(tuple(Edge(**{name: getattr(e, name) for name in names}) for e in self.edges))
