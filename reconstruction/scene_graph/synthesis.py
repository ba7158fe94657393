"""Synthesize the scene graph from the views of all regions: the paper's online merging, and its baselines."""

from collections.abc import Callable, Sequence

from reconstruction.core.progress import NO_PROGRESS, Progress
from reconstruction.scene_graph.base import (
    LocalGraph,
    MergedGraph,
    MergeStep,
    Question,
    RelationBackend,
    SaidEdge,
)
from reconstruction.scene_graph.merge import GraphMerge


def synthesize(
    questions: Sequence[Question],
    base_ids: Sequence[int],
    object_ids: Sequence[int],
    backend: RelationBackend,
    *,
    merging: str = "online",
    adjudications: int = 3,
    last_resort: Callable[[], RelationBackend] | None = None,
    progress: Progress = NO_PROGRESS,
) -> MergedGraph:
    """Ask about every region and merge the answers; the result does not depend on the order of `questions`.

    Args:
        questions: one per region; together they should cover all objects.
        base_ids: ids of floor, walls and ceiling, the floor first.
        object_ids: ids of all objects.
        backend: answers questions.
        merging: "online"; "naive": conflicts keep the first edge; "global": one question about all objects.
        adjudications: largest number of further views of the objects of a conflict.
        last_resort: makes the backend for objects without an edge; None: the floor supports them.
        progress: receives steps, conflicts and problems.

    Returns:
        A forest rooted in the base, in which every object has one parent, and the steps of merging.
    """
    everything = Question.of(object_ids)
    if merging == "global":
        questions = [everything] if object_ids else []
    progress.start(len(questions), "relations")
    answers = []
    for question in questions:
        answers.append((question, backend.infer(question)))
        progress.advance()
    merge = GraphMerge(base_ids, backend if merging == "online" else None, adjudications)
    # A canonical order makes the outcome independent of the order in which regions arrive.
    for question, graph in sorted(answers, key=_canonical):
        merge.add_view(question.about, graph)
    if merging == "online":
        _ask_for_the_rest(merge, questions, object_ids, backend, adjudications)
    missing = [i for i in sorted(object_ids) if i not in merge.parent_edge]
    if missing:
        _decide_the_rest(merge, missing, everything, last_resort)
    _tell(merge.steps, missing, progress)
    return MergedGraph(merge.edges(), tuple(merge.steps))


def _canonical(item: tuple[Question, LocalGraph]) -> tuple:
    question, graph = item
    return question.about, question.visible, sorted((e.child, e.parent, e.relation) for e in graph.edges)


def _ask_for_the_rest(
    merge: GraphMerge,
    questions: Sequence[Question],
    object_ids: Sequence[int],
    backend: RelationBackend,
    attempts: int,
) -> None:
    """Ask again, region by region, about objects that are not connected to the base."""
    for _ in range(attempts):
        for question in sorted(questions, key=lambda q: (q.about, q.visible)):
            missing = {i for i in question.about if i not in merge.parent_edge}
            if not missing:
                continue
            wanted = {merge.loose[i].parent for i in missing if i in merge.loose} - merge.base_ids
            again = merge.another_look(missing | wanted, question.visible)
            merge.add_view(again.about, backend.infer(again), "rest")
        if all(i in merge.parent_edge for i in object_ids):
            return


def _decide_the_rest(
    merge: GraphMerge,
    missing: Sequence[int],
    everything: Question,
    last_resort: Callable[[], RelationBackend] | None,
) -> None:
    """Give parents to objects that are not connected to the base; loose edges to one of them are kept."""
    if last_resort is None:
        floor = merge.floor
        known = [SaidEdge(i, "supported_by", floor, 0.05, "no relation was found", "nobody") for i in missing]
    else:
        known = [e for e in last_resort().infer(everything).edges if e.child in set(missing)]
    merge.put((e for e in known if e.child not in merge.loose), "no view says")
    merge.put((e for e in known if e.child not in merge.parent_edge), "no view says")


def _tell(steps: Sequence[MergeStep], missing: Sequence[int], progress: Progress) -> None:
    """Note conflicts, problems of the backend, and objects without an edge."""
    for step in steps:
        for line in step.notes:
            progress.note(line)
        for done in step.decisions:
            if done.verdict == "conflict":
                progress.note(f"{done.child} {done.relation} {done.parent}: {done.why}")
            elif done.verdict == "replaced":
                progress.note(f"settled: {done.child} {done.relation} {done.parent}, {done.why}")
    if missing:
        progress.note(f"no view says what {', '.join(map(str, missing))} rest on")
