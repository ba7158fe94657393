"""The seam to whoever says what carries what: a question about a view, a local graph as the answer."""

from collections.abc import Iterable
from dataclasses import dataclass, fields
from typing import Protocol

import numpy as np

from reconstruction.core.types import Edge, SceneGraph

RELATIONS = ("supported_by", "attached_to")


@dataclass(frozen=True)
class SaidEdge(Edge):
    """An edge, and who said so: "geometry", or the name of a model."""

    said_by: str = "geometry"


@dataclass(frozen=True)
class Question:
    """What a backend is asked: which of the objects in a view rest on or hang from what?"""

    about: tuple[int, ...]  # objects that the view is chosen for: a region, or those of a conflict
    visible: tuple[
        int, ...
    ]  # all objects that may be named, those of `about` included; floor and walls always may
    attempt: int = 0  # how often the same was asked before: backends that look choose another view each time

    @classmethod
    def of(cls, about: Iterable[int], visible: Iterable[int] = (), attempt: int = 0) -> "Question":
        """Make a question with its ids in order."""
        about = set(about)
        return cls(tuple(sorted(about)), tuple(sorted(about | set(visible))), attempt)


@dataclass(frozen=True)
class LocalGraph:
    """What a view says: at most one parent for each object that it shows; no cycle."""

    edges: tuple[SaidEdge, ...]
    visible: tuple[int, ...]  # objects that the backend could see
    picture: np.ndarray | None = None  # uint8 (h, w, 3) what it was shown, if it was shown a picture
    notes: tuple[str, ...] = ()  # what went wrong, for people


class RelationBackend(Protocol):
    """Proposes parents for the objects of a view: geometry, a vision-language model, ...

    All of an answer's ids are among `Question.visible` and the base, children are objects, no object has two parents
    or is its own ancestor. An object without an edge is one of which the view says nothing. The same question gets the
    same answer.
    """

    name: str

    def infer(self, question: Question) -> LocalGraph:
        """Answer a question."""
        ...


@dataclass(frozen=True)
class Decision:
    """What became of one edge that a view said."""

    child: int
    relation: str
    parent: int
    verdict: str  # "new", "known", "redundant", "conflict", "kept", "replaced", "loose", "refused"
    why: str


@dataclass(frozen=True)
class MergeStep:
    """One view, what it said, and the graph after it."""

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
    """What the stage makes: the scene graph with who said each edge, and how it came about."""

    edges: tuple[SaidEdge, ...]
    steps: tuple[MergeStep, ...] = ()

    def plain(self) -> SceneGraph:
        """Return the edges alone."""
        names = [field.name for field in fields(Edge)]
        return SceneGraph(tuple(Edge(**{name: getattr(e, name) for name in names}) for e in self.edges))
