"""The scene graph benchmark on a few rooms: its figures, its lies, its page."""

import numpy as np
import pytest

from benchmarks.graph import Disturbance, disturbed, kind_of, main, measure_geometry, room_specs
from benchmarks.graph_page import KINDS
from benchmarks.lying import LyingRelations, TrueRelations
from reconstruction.scene_graph import Question
from synthetic.procedural import plan_room, unpainted
from synthetic.true_assets import true_assets, true_edges

pytestmark = pytest.mark.stage


def test_rooms_hold_every_kind_of_relation():
    kinds = [
        k
        for spec in (room_specs(5)[3], room_specs(5)[4])
        for k in kind_of(unpainted(plan_room(spec))).values()
    ]
    assert set(kinds) == set(KINDS)


def test_geometry_is_measured_and_wrong_edges_are_counted():
    specs = room_specs(1)
    assert measure_geometry(specs, Disturbance()).f1 == 1.0
    far = measure_geometry(specs, Disturbance(0.3, 20.0))
    assert far.f1 < 0.9
    assert len(far.errors) == sum(total - right for right, total in far.counts.values()) > 0


def test_disturbed_things_are_as_far_off_as_is_said():
    assets = true_assets(unpainted(plan_room(room_specs(1)[0])))
    moved = disturbed(assets, Disturbance(0.01, 2.0), 0)
    for before, after in zip(assets.objects, moved.objects):
        away = after.world_from_object[:3, 3] - before.world_from_object[:3, 3]
        assert 0 < np.abs(away).max() <= 0.01
        up = after.world_from_object[:3, 2] @ before.world_from_object[:3, 2]
        assert np.degrees(np.arccos(min(up, 1.0))) <= 2.0 + 1e-6


def test_lies_have_the_shares_that_are_asked_for_and_are_told_again():
    room = unpainted(plan_room(room_specs(2)[1]))
    truth = true_edges(room)
    base = tuple(e.id for e in room.base)
    fates = []
    for seed in range(60):
        liar = LyingRelations(TrueRelations(truth), base, seed, wrong=0.2, missing=0.3)
        said = liar.infer(Question.of(truth))
        assert liar.infer(Question.of(truth)).edges == said.edges
        right = {(e.child, e.relation, e.parent) for e in truth.values()}
        wrong = [e for e in said.edges if (e.child, e.relation, e.parent) not in right]
        fates.append((len(wrong) / len(truth), 1 - len(said.edges) / len(truth)))
    assert np.allclose(np.mean(fates, axis=0), (0.2, 0.3), atol=0.03)


def test_the_page_is_written(tmp_path, capsys):
    page = tmp_path / "page.md"
    assert main(["--rooms", "1", "--lying-rooms", "1", "--seeds", "1", "--page", str(page)]) == 0
    text = page.read_text()
    assert text.count("| `online` |") == 4
    assert "| true | 1.000 |" in text
    assert main(["--rooms", "0"]) == 2
    assert "at least 1" in capsys.readouterr().err
