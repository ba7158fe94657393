"""Relation backends for tests: one that knows the truth, and rooms of which everything is known."""

from reconstruction.scene_graph import LocalGraph, Question, SaidEdge
from synthetic.procedural import RoomSpec, plan_room, unpainted
from synthetic.room import Room

FLOOR = 1


def said(child, parent, relation="supported_by", by="test") -> SaidEdge:
    return SaidEdge(child, relation, parent, 0.9, "seen", by)


class Oracle:
    """Answers as the truth says, restricted to what is in view: of what hides, the next one down."""

    name = "oracle"

    def __init__(self, truth: dict[int, int], base=(FLOOR,)) -> None:
        self.truth, self.base = truth, base
        self.asked: list[Question] = []

    def infer(self, question: Question) -> LocalGraph:
        self.asked.append(question)
        return self.view(question.visible)

    def view(self, ids) -> LocalGraph:
        out = []
        for i in sorted(ids):
            parent = self.truth[i]
            while parent not in ids and parent not in self.base:
                parent = self.truth[parent]
            out.append(said(i, parent))
        return LocalGraph(tuple(out), tuple(sorted(ids)))


def forest_problem(edges, base, objects) -> str:
    """Say why edges are no forest rooted in the base with all objects in it; "" if they are one."""
    parent = {e.child: e.parent for e in edges}
    if len(parent) != len(edges) or set(parent) != set(objects):
        return f"children {sorted(e.child for e in edges)} of {sorted(objects)}"
    for start in objects:
        node, steps = start, 0
        while node not in base:
            node, steps = parent.get(node), steps + 1
            if node is None or steps > len(objects):
                return f"no path from {start} to the base"
    return ""


def small_room(seed: int, objects: int = 12) -> Room:
    return unpainted(plan_room(RoomSpec(seed=seed, objects=objects, stacks=0.4, containers=0.1)))
