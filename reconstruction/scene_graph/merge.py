"""Merge the regions' graphs into one (the paper, section 3.3): add, drop the implied, settle conflicts."""

from collections import deque
from collections.abc import Iterable, Sequence

from reconstruction.scene_graph.relations import RelationBackend
from reconstruction.types import Edge


class GraphMerge:
    """The global graph while it grows: one parent per object, rooted in the base, never a cycle."""

    def __init__(self, base_ids: Iterable[int], backend: RelationBackend | None) -> None:
        """Start from the base; without a backend a conflict keeps what came first (the `naive` baseline)."""
        self.base_ids = frozenset(base_ids)
        self.backend = backend
        self.parent_edge: dict[int, Edge] = {}
        self.conflicts: list[str] = []

    def add_graph(self, edges: Sequence[Edge]) -> None:
        """Merge one region's edges, breadth first from the base."""
        for edge in breadth_first(edges, self.base_ids):
            self._add(edge)

    def ancestors(self, node: int) -> list[int]:
        """Return the chain of parents of a node, nearest first."""
        out = []
        while node in self.parent_edge:
            node = self.parent_edge[node].parent
            out.append(node)
        return out

    def _add(self, edge: Edge) -> None:
        known = edge.child in self.parent_edge
        if not known:
            # Its parent is known: the walk is breadth first and the region's graph is rooted in the base.
            if edge.parent in self.base_ids or edge.parent in self.parent_edge:
                self.parent_edge[edge.child] = edge
            return
        if self._implied(edge):
            return
        nodes = self._path(edge)
        self.conflicts.append(
            f"{edge.child} {edge.relation} {edge.parent} against {self.parent_edge[edge.child].relation} "
            f"{self.parent_edge[edge.child].parent}, settled among {sorted(nodes)}"
        )
        if self.backend is None:
            return
        for settled in breadth_first(self.backend.infer(nodes), self.base_ids):
            self._replace(settled)

    def _implied(self, edge: Edge) -> bool:
        """Tell whether the graph already says so: directly, or through a chain of supports."""
        chain: list[str] = []
        node = edge.child
        while node in self.parent_edge:
            chain.append(self.parent_edge[node].relation)
            node = self.parent_edge[node].parent
            if node == edge.parent:
                return all(relation == edge.relation for relation in chain)
        return False

    def _path(self, edge: Edge) -> set[int]:
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

    def _replace(self, edge: Edge) -> None:
        """Put a settled edge in place of the old one unless that would close a cycle."""
        if edge.parent not in self.base_ids and edge.parent not in self.parent_edge:
            return
        if edge.child != edge.parent and edge.child not in self.ancestors(edge.parent):
            self.parent_edge[edge.child] = edge


def breadth_first(edges: Sequence[Edge], roots: Iterable[int]) -> list[Edge]:
    """Order edges breadth first from the roots, by id within a level; what is not reached is left out."""
    children: dict[int, list[Edge]] = {}
    for edge in edges:
        children.setdefault(edge.parent, []).append(edge)
    out: list[Edge] = []
    queue = deque(sorted(roots))
    seen = set(queue)
    while queue:
        for edge in sorted(children.get(queue.popleft(), []), key=lambda e: e.child):
            if edge.child not in seen:
                seen.add(edge.child)
                out.append(edge)
                queue.append(edge.child)
    return out
