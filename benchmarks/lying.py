"""A relation backend that lies: seeded shares of its edges are wrong or missing, whatever it is asked."""

import hashlib
from collections.abc import Mapping

import numpy as np

from reconstruction.core.types import Edge
from reconstruction.scene_graph import LocalGraph, Question, RelationBackend, SaidEdge


class TrueRelations:
    """A `RelationBackend` that knows the truth; of what stands on hidden things, it names the next below."""

    name = "truth"

    def __init__(self, edges: Mapping[int, Edge]) -> None:
        """Take the true edges by child."""
        self._edges = edges

    def infer(self, question: Question) -> LocalGraph:
        """See `RelationBackend.infer`."""
        out = []
        for child in question.visible:
            edge = self._edges[child]
            parent, relation = edge.parent, edge.relation
            while parent in self._edges and parent not in question.visible:
                parent, relation = self._edges[parent].parent, self._edges[parent].relation
            out.append(SaidEdge(child, relation, parent, 0.9, "seen", self.name))
        return LocalGraph(tuple(out), question.visible)


class LyingRelations:
    """Wraps a `RelationBackend`. Each question is lied to anew, but the same question always alike.

    A wrong edge names another parent (an object in view, floor or a wall) or the other relation. It never closes a
    circle within an answer: such answers are caught before they get as far (`scene_graph.checking`).
    """

    name = "lying"

    def __init__(
        self, honest: RelationBackend, base_ids: tuple[int, ...], seed: int, wrong: float, missing: float
    ) -> None:
        """Lie about this share of edges, and keep silent about that share."""
        self._honest, self._base = honest, base_ids
        self._seed, self._wrong, self._missing = seed, wrong, missing
        self.asked = 0

    def infer(self, question: Question) -> LocalGraph:
        """See `RelationBackend.infer`."""
        self.asked += 1
        told = hashlib.sha256(repr((self._seed, question)).encode()).digest()
        rng = np.random.default_rng(list(told[:16]))
        graph = self._honest.infer(question)
        parents = {edge.child: edge.parent for edge in graph.edges}
        edges = []
        for edge in graph.edges:
            fate = rng.random()
            if fate < self._missing:
                del parents[edge.child]
                continue
            if fate < self._missing + self._wrong:
                edge = self._false(edge, graph, parents, rng)
                parents[edge.child] = edge.parent
            edges.append(edge)
        return LocalGraph(tuple(edges), graph.visible)

    def _false(
        self, edge: SaidEdge, graph: LocalGraph, parents: dict[int, int], rng: np.random.Generator
    ) -> SaidEdge:
        """Return another edge of the same child."""
        if rng.random() < 0.15:
            other = "attached_to" if edge.relation == "supported_by" else "supported_by"
            return SaidEdge(edge.child, other, edge.parent, 0.9, "a lie", self.name)
        parent = edge.parent
        choices = [i for i in (*self._base, *graph.visible) if i not in (edge.child, parent)]
        rng.shuffle(choices)
        for choice in choices:
            if not _leads_to(choice, edge.child, parents):
                parent = int(choice)
                break
        return SaidEdge(edge.child, edge.relation, parent, 0.9, "a lie", self.name)


def _leads_to(node: int, goal: int, parents: dict[int, int]) -> bool:
    while node in parents:
        node = parents[node]
        if node == goal:
            return True
    return False
