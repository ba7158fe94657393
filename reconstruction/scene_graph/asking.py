"""Relations by a vision-language model that sees a view of each region with numbered objects (Set-of-Mark)."""

from pathlib import Path
from typing import Literal, Protocol

from pydantic import BaseModel, ConfigDict

from reconstruction.core.types import AssetSet
from reconstruction.learned.conversation import Conversation, VlmError, VlmUnavailable
from reconstruction.scene_graph.base import LocalGraph, Question, SaidEdge
from reconstruction.scene_graph.checking import Findings, Triple, examine, listed
from reconstruction.scene_graph.looking import RegionPicture
from reconstruction.scene_graph.relations import GeometryRelations

# Confidence of a model's edge: it is the best candidate of geometry, another candidate, or none.
_AGREED, _POSSIBLE, _UNLIKELY = 0.9, 0.6, 0.4


# The docstrings of these two classes are part of the schema that the model is sent and that records are found by.
class Relation(BaseModel):
    """One edge of an answer."""

    model_config = ConfigDict(extra="forbid")

    child: int
    relation: Literal["supported_by", "attached_to"]
    parent: int


class Relations(BaseModel):
    """What the model answers."""

    model_config = ConfigDict(extra="forbid")

    edges: list[Relation]
    unclear: list[int]


class Viewer(Protocol):
    """Renders what a question is about."""

    def look(self, question: Question) -> RegionPicture | None:
        """Return a picture; None if no object can be seen."""
        ...


class PictureRelations:
    """A `RelationBackend` that asks a model; geometry decides where its answer is unusable, and the edge says so."""

    def __init__(
        self,
        model: Conversation,
        viewer: Viewer,
        assets: AssetSet,
        geometry: GeometryRelations,
        reach_m: float,
    ) -> None:
        """Wrap a model.

        Args:
            model: answers questions.
            viewer: renders the views for it.
            assets: base surfaces and objects, whose labels are in the prompt.
            geometry: fallback for edges that stay invalid after all attempts.
            reach_m: largest distance between an object and its parent.
        """
        self._model, self._viewer, self._geometry, self._reach_m = model, viewer, geometry, reach_m
        self._labels = assets.static_labels | {item.id: item.label for item in assets.objects}
        self._base = tuple(assets.static_labels)
        self._walls = tuple(item.id for item in assets.base if item.label != "floor")
        self._prompt = (Path(__file__).parent / "prompt.txt").read_text()
        self._away = ""  # why the model cannot be used any more
        self.name = model.name

    def infer(self, question: Question) -> LocalGraph:
        """See `RelationBackend.infer`."""
        if self._away:
            return self._by_geometry(question, ())
        view = self._viewer.look(question)
        if view is None:
            why = f"objects {listed(question.about)} can be seen from nowhere; geometry decides"
            return self._by_geometry(question, (why,))
        try:
            answer, problem = self._ask(view), ""
        except VlmUnavailable as error:
            self._away = str(error)
            return self._by_geometry(question, (f"{error}; geometry decides from here on",))
        except VlmError as error:
            if not isinstance(error.answer, Relations):
                why = f"{error}; geometry decides on {listed(view.visible)}"
                return self._by_geometry(question, (why,), view)
            answer, problem = error.answer, str(error)
        return self._graph(answer, problem, question, view)

    def _ask(self, view: RegionPicture) -> Relations:
        def named(ids: tuple[int, ...]) -> str:
            return "\n".join(f"- {i}: {self._labels[i]}" for i in ids)

        prompt = self._prompt.format(objects=named(view.visible), base=named(self._base))

        def check(answer: Relations) -> None:
            found = self._examine(_triples(answer), view, answer.unclear)
            unknown = sorted(set(answer.unclear) - set(view.visible))
            problems = found.problems + [f"unclear: there is no object {i}" for i in unknown]
            if problems:
                raise ValueError("; ".join(problems[:8]))

        return self._model.ask(prompt, [view.picture], Relations, check)

    def _examine(self, triples: list[Triple], view: RegionPicture, silent: list[int]) -> Findings:
        near = self._geometry.distance_m
        return examine(triples, view.visible, self._base, silent, self._walls, near, self._reach_m)

    def _graph(self, answer: Relations, problem: str, question: Question, view: RegionPicture) -> LocalGraph:
        """Take the valid edges of an answer; geometry decides on the other visible objects."""
        triples = _triples(answer)
        bad = self._examine(triples, view, answer.unclear).children
        said = {t[0]: t for t in triples if t[0] in view.visible and t[0] not in bad}
        edges = {child: self._edge(said[child], view.visible) for child in sorted(said)}
        # Edges by geometry must not close cycles with edges by the model.
        for edge in self._geometry.infer(Question.of(view.visible)).edges if bad else ():
            if edge.child in bad:
                edges[edge.child] = _instead(edge, self.name)
        parents = {child: edge.parent for child, edge in edges.items()}
        for child in sorted(bad & set(edges)):
            if _loops(child, parents):
                del edges[child], parents[child]
        left = f"geometry decides on {listed(bad)}" if bad else "the rest of it is used"
        notes = (f"{problem}; {left}",) if problem else ()
        return LocalGraph(tuple(edges.values()), view.visible, view.picture, notes)

    def _edge(self, triple: Triple, visible: tuple[int, ...]) -> SaidEdge:
        """Make the edge of an answer, with the confidence by its rank among the candidates of geometry."""
        child, relation, parent = triple
        ranked = self._geometry.candidates(child, visible)
        rank = next((k for k, c in enumerate(ranked) if (c.relation, c.parent) == (relation, parent)), None)
        if rank is None:
            confidence, words = _UNLIKELY, f"geometry finds no contact; {ranked[0].evidence}"
        elif rank == 0:
            confidence, words = _AGREED, f"geometry agrees: {ranked[0].evidence}"
        else:
            confidence = _POSSIBLE
            words = f"geometry thinks of {ranked[0].parent} first; {ranked[rank].evidence}"
        return SaidEdge(child, relation, parent, confidence, f"{self.name} says so; {words}", self.name)

    def _by_geometry(
        self, question: Question, notes: tuple[str, ...], view: RegionPicture | None = None
    ) -> LocalGraph:
        """Answer by geometry, on the objects that the view shows if there is one."""
        visible = question.visible if view is None else view.visible
        graph = self._geometry.infer(Question.of(visible))
        edges = tuple(_instead(edge, self.name) for edge in graph.edges)
        return LocalGraph(edges, graph.visible, None if view is None else view.picture, notes)


def _instead(edge: SaidEdge, model: str) -> SaidEdge:
    evidence = f"{edge.evidence}; {model} gave no usable answer"
    return SaidEdge(edge.child, edge.relation, edge.parent, edge.confidence, evidence, "geometry")


def _triples(answer: Relations) -> list[Triple]:
    return [(edge.child, edge.relation, edge.parent) for edge in answer.edges]


def _loops(child: int, parents: dict[int, int]) -> bool:
    """Tell whether the chain of parents of a child ends in a cycle."""
    node, seen = child, set()
    while node in parents and node not in seen:
        seen.add(node)
        node = parents[node]
    return node in seen
