"""Validate the edges of an answer; problems are worded for the model, which is asked again with them."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field

from reconstruction.scene_graph.base import RELATIONS

Triple = tuple[int, str, int]  # child, relation, parent


@dataclass
class Findings:
    """Problems of an answer."""

    problems: list[str] = field(default_factory=list)  # sentences for the model
    children: set[int] = field(default_factory=set)  # objects whose edges are invalid or missing

    def add(self, problem: str, *children: int) -> None:
        """Add a problem with the edges of `children`."""
        self.problems.append(problem)
        self.children.update(children)


def examine(
    triples: Sequence[Triple],
    visible: Collection[int],
    base: Collection[int],
    silent: Collection[int] = (),
    walls: Collection[int] = (),
    distance_m: Callable[[int, int], float] | None = None,
    reach_m: float = float("inf"),
) -> Findings:
    """Find unknown ids, second parents, cycles, missing edges and parents out of reach.

    Args:
        triples: edges of the answer.
        visible: ids of the objects of the question.
        base: ids of floor, walls and ceiling.
        silent: objects that the answer declares unclear; they need no edge.
        walls: base surfaces that cannot support objects.
        distance_m: returns the distance between an object and a parent.
        reach_m: largest distance to a parent.
    """
    out, parents = Findings(), {}
    for child, relation, parent in triples:
        said = f"({child}, {relation}, {parent})"
        if child in base:
            out.add(f"{said}: {child} is floor, wall or ceiling; these have no parent")
        elif child not in visible:
            out.add(f"{said}: there is no object {child}; the objects are {listed(visible)}")
        elif relation not in RELATIONS:
            out.add(f"{said}: {relation!r} is none of {', '.join(RELATIONS)}", child)
        elif child == parent:
            out.add(f"{said}: nothing is its own parent", child)
        elif parent not in visible and parent not in base:
            out.add(f"{said}: there is no {parent}; parents are {listed({*visible, *base})}", child)
        elif parent in walls and relation == "supported_by":
            out.add(f"{said}: nothing stands on {parent}; what hangs there is attached_to it", child)
        elif parents.setdefault(child, (relation, parent)) != (relation, parent):
            out.add(f"object {child} has two parents, {parents[child][1]} and {parent}; name one", child)
        elif distance_m is not None and distance_m(child, parent) > reach_m:
            apart = distance_m(child, parent)
            out.add(f"{said}: they are {100 * apart:.0f} cm apart and cannot touch", child)
    for cycle in find_cycles({c: p for c, (_, p) in parents.items() if c not in out.children}):
        chain = " on ".join(map(str, [*cycle, cycle[0]]))
        out.add(f"{chain}: that is a circle; one of them must rest on something else", *cycle)
    missing = sorted(set(visible) - set(parents) - set(silent) - out.children)
    if missing:
        out.add(f"there is no edge for {listed(missing)}", *missing)
    return out


def find_cycles(parent: Mapping[int, int]) -> list[list[int]]:
    """Return the ids along each cycle of a map from children to parents."""
    out, done = [], set()
    for start in sorted(parent):
        path, node = [], start
        while node in parent and node not in done and node not in path:
            path.append(node)
            node = parent[node]
        if node in path:
            out.append(path[path.index(node) :])
        done.update(path)
    return out


def listed(ids: Collection[int]) -> str:
    """Format ids, sorted and separated by commas."""
    return ", ".join(map(str, sorted(ids)))
