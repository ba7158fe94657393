"""Merge the views' graphs into one (the paper, section 3.3): add, drop the implied, settle conflicts by another view.

Each view's edges are walked breadth first from floor and walls. A new object is added; where both ends are known, a
path that says the same makes the edge redundant; no path, other relations on it, or the reverse order are a conflict:
the objects on the path are looked at again, and what that view says replaces what the graph said. Where the views then
name different parents, the one that most of them name counts (of equals, the one named last), and they are looked at
again until one is named twice. A view that does not show a candidate says nothing against it.
"""

from collections import Counter, deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from reconstruction.scene_graph.base import (
    Decision,
    LocalGraph,
    MergeStep,
    Question,
    RelationBackend,
    SaidEdge,
)


@dataclass(frozen=True)
class _Claim:
    edge: SaidEdge
    visible: frozenset[int]  # in the view that says so


class GraphMerge:
    """The global graph while it grows: at most one parent per object, rooted in the base, never a cycle."""

    def __init__(
        self, base_ids: Sequence[int], backend: RelationBackend | None, adjudications: int = 3
    ) -> None:
        """Start from the base, floor first; without a backend what came first stays (the `naive` baseline)."""
        self.base_ids, self.floor = frozenset(base_ids), base_ids[0]
        self.backend, self.adjudications = backend, adjudications
        self.parent_edge: dict[int, SaidEdge] = {}
        self.steps: list[MergeStep] = []
        self.loose: dict[int, SaidEdge] = {}  # edges to parents that nothing is known of yet
        self._claims: dict[int, list[_Claim]] = {}
        self._looked_at: Counter[tuple[int, ...]] = Counter()

    def add_view(self, about: Iterable[int], graph: LocalGraph, kind: str = "region") -> None:
        """Merge one view's edges, then settle the conflicts that it brought."""
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
                if self._against(edge):  # settling another one may have settled it
                    self._settle(edge)

    def another_look(self, about: Iterable[int], visible: Iterable[int] = ()) -> Question:
        """Return a question about objects that was not asked before."""
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
        """Add edges of objects that no view spoke of, as a step of its own."""
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
        """Add an edge where nothing speaks against it; return what became of it and why."""
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
        """Return what in the graph contradicts an edge of a known object; "" where a path says the same."""
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
        """Look again at all objects on the path of a conflict, until one parent of each was named twice."""
        nodes = self._path(edge)
        for _ in range(self.adjudications):
            answer = self.backend.infer(self.another_look(nodes))
            self._looked_at[tuple(sorted(nodes))] += 1
            self._note_claims(answer)
            winners = {}
            open_ended = False
            for child in sorted(nodes):
                edge_of_child, votes, rivals = self._vote(child)
                if edge_of_child is not None:
                    winners[child] = edge_of_child
                open_ended |= votes < 2 and rivals > 1
            self._record("adjudication", nodes, answer, self._replace(winners))
            if not open_ended:
                return

    def _vote(self, child: int) -> tuple[SaidEdge | None, int, int]:
        """Return the parent that most views name, how many do, and how many parents are named at all.

        Only views count that show all the parents that were named.
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
        """Put edges in place of others, in an order in which none closes a cycle; what would stays as it was."""
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
            decisions.append(
                Decision(child, edge.relation, edge.parent, "refused", "it would close a circle")
            )
        return decisions

    def _path(self, edge: SaidEdge) -> set[int]:
        """Return the objects between child and parent in the graph, and what each of them rests on.

        Without their carriers in view, the answer could only be worse than what is known.
        """
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
        """Add edges that waited for their parent to become known."""
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
        self.steps.append(
            MergeStep(
                kind,
                tuple(sorted(about)),
                graph.visible,
                tuple(sorted(graph.edges, key=_order)),
                tuple(decisions),
                self.edges(),
                graph.picture,
                graph.notes,
            )
        )


def breadth_first(edges: Sequence[SaidEdge], roots: Iterable[int]) -> list[SaidEdge]:
    """Order edges breadth first from the roots, by id within a level; what is not reached is left out."""
    children: dict[int, list[SaidEdge]] = {}
    for edge in edges:
        children.setdefault(edge.parent, []).append(edge)
    out: list[SaidEdge] = []
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
