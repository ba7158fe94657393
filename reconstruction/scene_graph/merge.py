"""Merge local graphs into a global one (the paper, section 3.3): add edges, drop implied ones, resolve conflicts.

The edges of a view are processed breadth first from the base. An edge of a new object is added. An edge between known
objects is redundant if the graph has a path with the same relation between them. No path, another relation on it, or
the reverse order are a conflict. The objects on the path of a conflict are viewed again, and each gets the parent that
most views name (of equals, the one named last), until one parent has two votes. Only views that show all named
candidates count.
"""

from collections import Counter, deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TypeVar

from reconstruction.core.types import Edge
from reconstruction.scene_graph.base import (
    Decision,
    LocalGraph,
    MergeStep,
    Question,
    RelationBackend,
    SaidEdge,
)

AnyEdge = TypeVar("AnyEdge", bound=Edge)


@dataclass(frozen=True)
class _Claim:
    edge: SaidEdge
    visible: frozenset[int]  # objects in the view that the edge is from


class GraphMerge:
    """The global graph during merging: at most one parent per object, rooted in the base, without cycles."""

    def __init__(
        self, base_ids: Sequence[int], backend: RelationBackend | None, adjudications: int = 3
    ) -> None:
        """Start from the base, floor first; without a backend conflicts keep the first edge (the `naive` baseline)."""
        self.base_ids, self.floor = frozenset(base_ids), base_ids[0]
        self.backend, self.adjudications = backend, adjudications
        self.parent_edge: dict[int, SaidEdge] = {}
        self.steps: list[MergeStep] = []
        self.loose: dict[int, SaidEdge] = {}  # edges to parents that are not in the graph yet
        self._claims: dict[int, list[_Claim]] = {}
        self._looked_at: Counter[tuple[int, ...]] = Counter()

    def add_view(self, about: Iterable[int], graph: LocalGraph, kind: str = "region") -> None:
        """Merge the edges of a view, then resolve its conflicts."""
        self._looked_at[tuple(sorted(about))] += 1
        self._note_claims(graph)
        conflicts: list[SaidEdge] = []
        decisions = []
        reached = breadth_first(graph.edges, self.base_ids)
        known = {e.child for e in reached}
        for edge in [*reached, *sorted((e for e in graph.edges if e.child not in known), key=_order)]:
            verdict, why = self._add(edge)
            decisions.append(Decision(edge.child, edge.relation, edge.parent, verdict, why))
            if verdict == "conflict":
                conflicts.append(edge)
        self._tie_loose()
        self._record(kind, about, graph, decisions)
        if self.backend is not None:
            for edge in conflicts:
                if self._against(edge):  # may be resolved with another one
                    self._settle(edge)

    def another_look(self, about: Iterable[int], visible: Iterable[int] = ()) -> Question:
        """Return the next question about objects, which gets another view than earlier ones."""
        return Question.of(about, visible, self._looked_at[tuple(sorted(about))])

    def ancestors(self, node: int) -> list[int]:
        """Return the chain of parents of a node, nearest first."""
        out = []
        while node in self.parent_edge:
            node = self.parent_edge[node].parent
            out.append(node)
        return out

    def edges(self) -> tuple[SaidEdge, ...]:
        """Return the edges, breadth first from the base."""
        return tuple(breadth_first(list(self.parent_edge.values()), self.base_ids))

    def put(self, edges: Iterable[SaidEdge], why: str) -> None:
        """Add edges of objects that no view connects to the base, as a step of its own."""
        said = tuple(edges)
        if not said:
            return
        decisions = []
        for edge in breadth_first([*self.parent_edge.values(), *said], self.base_ids):
            if edge.child not in self.parent_edge:
                self.parent_edge[edge.child] = edge
                decisions.append(Decision(edge.child, edge.relation, edge.parent, "new", why))
        self._tie_loose()
        about = tuple(sorted(e.child for e in said))
        self._record("fallback", about, LocalGraph(said, about), decisions)

    def _add(self, edge: SaidEdge) -> tuple[str, str]:
        """Add an edge if it is new and consistent; return the verdict and the reason."""
        if edge.child not in self.parent_edge:
            if not self._rooted(edge.parent):
                self.loose.setdefault(edge.child, edge)
                return "loose", f"nothing is known of {edge.parent} yet"
            if edge.child == edge.parent or edge.child in self.ancestors(edge.parent):
                return "refused", "it would close a circle"
            self.parent_edge[edge.child] = edge
            return "new", "not in the graph before"
        against = self._against(edge)
        if against:
            return "conflict", against
        if self.parent_edge[edge.child].parent == edge.parent:
            return "known", "the graph says so"
        return "redundant", "a chain of the graph says so"

    def _against(self, edge: SaidEdge) -> str:
        """Return how the graph contradicts an edge of a known object; "" if a path has the same relation."""
        chain: list[str] = []
        node = edge.child
        while node in self.parent_edge:
            chain.append(self.parent_edge[node].relation)
            node = self.parent_edge[node].parent
            if node == edge.parent:
                same = all(relation == edge.relation for relation in chain)
                return "" if same else f"the path to {edge.parent} is {', '.join(chain)}"
        if edge.child in self.ancestors(edge.parent):
            return f"the graph has {edge.parent} on {edge.child}, the reverse order"
        return f"no path leads from {edge.child} to {edge.parent}"

    def _settle(self, edge: SaidEdge) -> None:
        """View the objects on the path of a conflict again, until each has a parent with two votes."""
        assert self.backend is not None
        nodes = self._path(edge)
        for _ in range(self.adjudications):
            answer = self.backend.infer(self.another_look(nodes))
            self._looked_at[tuple(sorted(nodes))] += 1
            self._note_claims(answer)
            found = {child: self._vote(child) for child in sorted(nodes)}
            winners = {child: edge for child, (edge, _, _) in found.items() if edge is not None}
            self._record("adjudication", nodes, answer, self._replace(winners))
            if not any(votes < 2 and rivals > 1 for _, votes, rivals in found.values()):
                return

    def _vote(self, child: int) -> tuple[SaidEdge | None, int, int]:
        """Return the edge with most votes, its votes, and the number of candidates.

        Only views that show all named parents vote, if there are any.
        """
        claims = self._claims.get(child, [])
        named = {c.edge.parent for c in claims} - self.base_ids
        fair = [c for c in claims if named <= c.visible] or claims
        if not fair:
            return None, 0, 0
        votes = Counter((c.edge.relation, c.edge.parent) for c in fair)
        last = {(c.edge.relation, c.edge.parent): (rank, c.edge) for rank, c in enumerate(fair)}
        best = max(votes, key=lambda key: (votes[key], last[key][0]))
        return last[best][1], votes[best], len(votes)

    def _replace(self, winners: dict[int, SaidEdge]) -> list[Decision]:
        """Replace edges, in an order in which none closes a cycle; refuse those that would."""
        decisions, waiting = [], dict(winners)
        progress = True
        while progress:
            progress = False
            for child, edge in sorted(waiting.items()):
                loop = child == edge.parent or child in self.ancestors(edge.parent)
                if loop or not self._rooted(edge.parent):
                    continue
                before = self.parent_edge.get(child)
                same = before is not None and (before.relation, before.parent) == (edge.relation, edge.parent)
                if not same:
                    self.parent_edge[child] = edge
                verdict = "kept" if same else "replaced" if before else "new"
                why = "" if same or before is None else f"was {before.relation} {before.parent}"
                decisions.append(Decision(child, edge.relation, edge.parent, verdict, why))
                del waiting[child]
                progress = True
        for child, edge in sorted(waiting.items()):
            why = "it would close a circle"
            decisions.append(Decision(child, edge.relation, edge.parent, "refused", why))
        return decisions

    def _path(self, edge: SaidEdge) -> set[int]:
        """Return the objects on the path between child and parent in the graph, and their parents."""
        up = [edge.child, *self.ancestors(edge.child)]
        down = [edge.parent, *self.ancestors(edge.parent)]
        common = next((node for node in up if node in down), None)
        if common is None:
            nodes = {*up, *down}
        else:
            nodes = {*up[: up.index(common) + 1], *down[: down.index(common) + 1]}
        nodes |= {self.parent_edge[node].parent for node in nodes if node in self.parent_edge}
        return nodes - self.base_ids

    def _rooted(self, node: int) -> bool:
        return node in self.base_ids or node in self.parent_edge

    def _tie_loose(self) -> None:
        """Add loose edges whose parents are in the graph now."""
        progress = True
        while progress:
            progress = False
            for child, edge in sorted(self.loose.items()):
                if child in self.parent_edge:
                    del self.loose[child]
                elif self._rooted(edge.parent):
                    self.parent_edge[child] = self.loose.pop(child)
                    progress = True

    def _note_claims(self, graph: LocalGraph) -> None:
        visible = frozenset(graph.visible)
        for edge in graph.edges:
            self._claims.setdefault(edge.child, []).append(_Claim(edge, visible))

    def _record(
        self, kind: str, about: Iterable[int], graph: LocalGraph, decisions: Sequence[Decision]
    ) -> None:
        ids, said = tuple(sorted(about)), tuple(sorted(graph.edges, key=_order))
        merged, made = self.edges(), tuple(decisions)
        self.steps.append(MergeStep(kind, ids, graph.visible, said, made, merged, graph.picture, graph.notes))


def breadth_first(edges: Sequence[AnyEdge], roots: Iterable[int]) -> list[AnyEdge]:
    """Order edges breadth first from the roots, by child id within a level; unreachable edges are left out."""
    children: dict[int, list[AnyEdge]] = {}
    for edge in edges:
        children.setdefault(edge.parent, []).append(edge)
    out: list[AnyEdge] = []
    queue = deque(sorted(roots))
    seen = set(queue)
    while queue:
        for edge in sorted(children.get(queue.popleft(), []), key=lambda e: e.child):
            if edge.child not in seen:
                seen.add(edge.child)
                out.append(edge)
                queue.append(edge.child)
    return out


def _order(edge: SaidEdge) -> tuple[int, int, str]:
    return edge.child, edge.parent, edge.relation
