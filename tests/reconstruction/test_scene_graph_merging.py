"""Merging of regions: new, known, implied, contradicting edges; always a forest; the order of regions is nothing."""

import itertools

import numpy as np
import pytest
from boxes import box, room
from graph_backends import FLOOR, Oracle, forest_problem, said, small_room

from benchmarks.lying import LyingRelations, TrueRelations
from reconstruction.core.types import Camera
from reconstruction.scene_graph import (
    LocalGraph,
    Question,
    SceneGraphConfig,
    infer_scene_graph,
    region_questions,
    synthesize,
)
from reconstruction.scene_graph.merge import GraphMerge
from reconstruction.scene_graph.set_of_marks import id_map, number_things
from synthetic.true_assets import true_assets, true_edges

pytestmark = pytest.mark.stage

TRUTH = {10: FLOOR, 11: 10, 12: 11, 13: 10, 14: 13}


def local(*edges, visible=()) -> LocalGraph:
    ids = {e.child for e in edges} | {e.parent for e in edges} | set(visible)
    return LocalGraph(tuple(edges), tuple(sorted(ids - {FLOOR, 2})))


class Views:
    """Says what a list holds for each region, and the truth where it is asked again."""

    name = "views"

    def __init__(self, graphs: dict[tuple[int, ...], LocalGraph], truth: dict[int, int]) -> None:
        self.graphs, self.oracle = graphs, Oracle(truth, (FLOOR, 2))

    def infer(self, question: Question) -> LocalGraph:
        regional = question.attempt == 0 and question.visible in self.graphs
        return self.graphs[question.visible] if regional else self.oracle.infer(question)


def merged(*graphs: LocalGraph, truth=TRUTH, **options):
    views = Views({g.visible: g for g in graphs}, truth)
    questions = [Question.of(g.visible) for g in graphs]
    return synthesize(questions, [FLOOR, 2], sorted(truth), views, **options), views.oracle


def parents(graph) -> dict[int, int]:
    return {e.child: e.parent for e in graph.edges}


def verdicts(graph, kind="region") -> dict[tuple[int, int], str]:
    return {(d.child, d.parent): d.verdict for s in graph.steps if s.kind == kind for d in s.decisions}


def test_an_edge_that_a_chain_implies_is_redundant_and_asks_nobody():
    full = Oracle(TRUTH)
    graph, oracle = merged(full.view([10, 11, 12, 13, 14]), full.view([10, 12]))
    assert parents(graph) == TRUTH
    assert oracle.asked == []
    assert verdicts(graph)[12, 10] == "redundant"


@pytest.mark.parametrize(
    ("wrong", "why"),
    [
        ([said(10, FLOOR), said(11, 10), said(12, 10)], "no path"),
        ([said(12, FLOOR), said(11, 12)], "reverse order"),
        ([said(10, FLOOR), said(11, 10), said(12, 11, "attached_to")], "the path to 11"),
    ],
)
def test_each_kind_of_conflict_is_looked_at_again_and_replaced(wrong, why):
    right = Oracle(TRUTH).view([10, 11, 12, 13])
    graph, oracle = merged(local(*wrong, visible=[10, 11, 12]), right)
    assert {k: v for k, v in parents(graph).items() if k != 14} == {k: v for k, v in TRUTH.items() if k != 14}
    assert {e.relation for e in graph.edges} == {"supported_by"}
    whys = [d.why for s in graph.steps for d in s.decisions if d.verdict == "conflict"]
    assert any(why in line for line in whys)
    adjudicated = [s for s in graph.steps if s.kind == "adjudication"]
    assert adjudicated
    assert {11, 12} <= set(adjudicated[0].about)
    assert "replaced" in [d.verdict for s in adjudicated for d in s.decisions]
    assert all(set(q.about) <= set(TRUTH) for q in oracle.asked)


def test_naive_merging_keeps_what_came_first_and_asks_nobody():
    wrong = local(said(10, FLOOR), said(11, 10), said(12, 10))
    graph, oracle = merged(wrong, Oracle(TRUTH).view([10, 11, 12, 13]), merging="naive")
    assert parents(graph)[12] == 10
    assert oracle.asked == []


def test_global_asks_one_question_about_everything():
    oracle = Oracle(TRUTH)
    graph = synthesize([Question.of([10, 11])], [FLOOR], sorted(TRUTH), oracle, merging="global")
    assert parents(graph) == TRUTH
    assert [q.visible for q in oracle.asked] == [tuple(sorted(TRUTH))]


def test_objects_that_no_view_connects_are_looked_at_again():
    graph, _ = merged(local(said(11, 10), said(12, 11)), local(said(13, 10), said(14, 13)))
    assert parents(graph) == TRUTH
    assert any(s.kind == "rest" for s in graph.steps)


def test_what_nobody_says_the_last_resort_decides_and_is_named():
    silent = Views({(10, 11): local(said(11, 10))}, {})
    silent.oracle.infer = lambda question: LocalGraph((), question.visible)
    honest = Oracle({10: FLOOR, 11: FLOOR})
    questions = [Question.of([10, 11])]
    graph = synthesize(questions, [FLOOR], [10, 11], silent, last_resort=lambda: honest)
    assert parents(graph) == {10: FLOOR, 11: 10}  # 11 keeps what was said of it
    without = synthesize(questions, [FLOOR], [10, 11], silent)
    assert {e.child: (e.parent, e.said_by) for e in without.edges} == {
        10: (FLOOR, "nobody"),
        11: (10, "test"),
    }


def test_a_view_that_does_not_show_a_candidate_says_nothing_against_it():
    blind = [local(said(10, FLOOR), said(12, 10), said(20 + k, FLOOR)) for k in range(3)]
    truth = TRUTH | {20: FLOOR, 21: FLOOR, 22: FLOOR}
    graph, _ = merged(*blind, Oracle(TRUTH).view([10, 11, 12]), truth=truth)
    assert parents(graph)[12] == 11


def test_steps_tell_how_every_edge_came_about():
    wrong = local(said(10, FLOOR), said(11, 10), said(12, 10))
    graph, _ = merged(wrong, Oracle(TRUTH).view([10, 11, 12, 13, 14]))
    assert {(e.child, e.parent) for e in graph.steps[-1].merged} == set(parents(graph).items())
    for step in graph.steps:
        assert {(d.child, d.parent) for d in step.decisions} >= {
            (e.child, e.parent) for e in step.said if step.kind == "region"
        }


def test_random_answers_give_the_same_forest_in_every_order_of_regions():
    rng = np.random.default_rng(0)
    ids = list(range(10, 17))
    for _ in range(12):
        truth = {i: int(rng.choice([FLOOR, 2, *range(10, i)])) for i in ids}
        graphs = []
        for _ in range(4):
            children = rng.choice(ids, 4, replace=False)
            picked = [said(int(i), int(rng.choice([FLOOR, 2, *ids]))) for i in children]
            # No cycles within a view: that is what backends keep to.
            merge = GraphMerge([FLOOR, 2], None)
            merge.add_view([], local(*picked))
            graphs.append(local(*(e for e in picked if e in merge.parent_edge.values()), visible=ids[:5]))
        results = set()
        for order in itertools.permutations(graphs):
            views = Views({g.visible: g for g in graphs}, truth)
            questions = [Question.of(g.visible) for g in order]
            graph = synthesize(questions, [FLOOR, 2], ids, views)
            assert forest_problem(graph.edges, {FLOOR, 2}, ids) == ""
            results.add(tuple(sorted((e.child, e.relation, e.parent) for e in graph.edges)))
        assert len(results) == 1


def test_a_backend_that_lies_is_outvoted():
    """On rooms with stacks and containers, 20 % of the edges wrong and 20 % missing."""
    scores = {"online": [], "naive": [], "global": []}
    for seed in (20, 21, 22):
        place = small_room(seed, 16)
        assets, truth = true_assets(place), true_edges(place)
        base = [e.id for e in place.base]
        questions = region_questions(assets, SceneGraphConfig())
        for merging, lies in itertools.product(scores, range(3)):
            liar = LyingRelations(TrueRelations(truth), tuple(base), lies, wrong=0.2, missing=0.2)
            graph = synthesize(questions, base, sorted(truth), liar, merging=merging)
            assert forest_problem(graph.edges, set(base), sorted(truth)) == ""
            right = [
                (e.relation, e.parent) == (truth[e.child].relation, truth[e.child].parent)
                for e in graph.edges
            ]
            scores[merging].append(np.mean(right))
            backwards = synthesize(questions[::-1], base, sorted(truth), liar, merging=merging)
            assert backwards.edges == graph.edges
    assert np.mean(scores["online"]) > np.mean(scores["naive"]) + 0.05
    assert np.mean(scores["online"]) > np.mean(scores["global"]) + 0.05


@pytest.mark.parametrize("seed", range(2))
def test_geometry_knows_who_stands_on_whom_in_generated_rooms(seed):
    place = small_room(seed, 14)
    graph = infer_scene_graph(true_assets(place), SceneGraphConfig())
    truth = true_edges(place)
    assert {e.child: (e.relation, e.parent) for e in graph.edges} == {
        i: (e.relation, e.parent) for i, e in truth.items()
    }


def test_numbers_are_on_the_picture_and_not_on_each_other():
    things = [box(3 + k, (0.05, 0.05, 0.05), (0.06 * (k % 4), 0.06 * (k // 4), 0)) for k in range(12)]
    assets = room(*things)
    camera = Camera(400, 300, 300.0, 300.0, 200.0, 150.0)
    pose = np.array([[1.0, 0, 0, 0.1], [0, -1, 0, 0.1], [0, 0, -1, 1.0], [0, 0, 0, 1]])
    ids = id_map(assets, camera, pose)
    assert set(range(3, 15)) <= set(np.unique(ids))
    gray = np.full((300, 400, 3), 128, np.uint8)
    with_all = number_things(gray, ids, {i: str(i) for i in range(3, 15)}, {1: "floor 1"})
    assert with_all.shape == gray.shape
    # Twelve boxes of the labels' own colors, each whole: nothing is drawn over a label.
    from reconstruction.scene_graph.set_of_marks import color_of

    for number in range(3, 15):
        own = (with_all == color_of(number)).all(axis=2).sum()
        alone = number_things(gray, np.where(ids == number, ids, 0), {number: str(number)}, {})
        assert own > 0.5 * (alone == color_of(number)).all(axis=2).sum()
