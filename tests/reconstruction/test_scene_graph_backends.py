"""Relation backends: what all of them keep to, what models answer and get wrong, and that answers can be replayed."""

import json
from dataclasses import replace

import numpy as np
import pytest
from avo_room import BALL, BOX, BOX_CENTER, BOX_SIDE, FLOOR, PANEL, PANEL_HEIGHT, PANEL_WIDTH, PANEL_Y
from avo_room import room as gaussian_room
from boxes import box, floor
from chat_server import Server, chat
from notes import Notes
from tiny_models import one_thread, save_qwen

from reconstruction.core.types import AssetSet
from reconstruction.learned.models import ModelRequest
from reconstruction.learned.qwen import QwenModel
from reconstruction.scene_graph import Question, SceneGraphConfig, infer_scene_graph, outside_inputs
from reconstruction.scene_graph.asking import PictureRelations
from reconstruction.scene_graph.base import RELATIONS
from reconstruction.scene_graph.checking import examine
from reconstruction.scene_graph.load import check_backend, load_relations
from reconstruction.scene_graph.looking import RegionViewer
from reconstruction.scene_graph.relations import GeometryRelations
from registry.errors import EnvironmentMissing

pytestmark = pytest.mark.stage

THINGS = (BOX, PANEL, BALL)
CONFIG = SceneGraphConfig(picture_side_px=256)


def assets() -> AssetSet:
    """The meshes of `avo_room.room`."""
    return AssetSet(
        (floor(FLOOR),),
        (
            box(BOX, (BOX_SIDE,) * 3, (*BOX_CENTER[:2], 0), label="crate"),
            box(PANEL, (PANEL_WIDTH, 0.01, PANEL_HEIGHT), (0, PANEL_Y, 0), label="panel"),
            box(BALL, (0.12, 0.12, 0.12), (0.7, 0.5, 0), label="ball"),
        ),
    )


@pytest.fixture(scope="module")
def scene():
    return gaussian_room()


def answer(*triples, unclear=()) -> str:
    edges = [{"child": c, "relation": r, "parent": p} for c, r, p in triples]
    return json.dumps({"edges": edges, "unclear": list(unclear)})


GOOD = answer(*((i, "supported_by", FLOOR) for i in THINGS))


@pytest.fixture
def endpoint(monkeypatch):
    with Server() as server:
        monkeypatch.setenv("SIMRECON_VLM_URL", server.url)
        monkeypatch.setenv("SIMRECON_VLM_MODEL", "tiny-vl")
        server.responses = [chat(GOOD)]
        yield server


@pytest.fixture(scope="module")
def qwen(tmp_path_factory):
    return save_qwen(tmp_path_factory.mktemp("qwen"))


@pytest.fixture(params=["geometry", "vlm", "qwen2.5-vl"])
def backend(request, scene, tmp_path):
    if request.param == "vlm":
        request.getfixturevalue("endpoint")
    if request.param == "qwen2.5-vl":
        model = QwenModel(ModelRequest(request.getfixturevalue("qwen"), "a", "b", "cpu"), tmp_path, 16)
        viewer = RegionViewer(assets(), lambda: scene, 256, CONFIG.least_visible)
        geometry = GeometryRelations(assets(), CONFIG.relations)
        return PictureRelations(model, viewer, assets(), geometry, CONFIG.reach_m)
    return load_relations(replace(CONFIG, backend=request.param), assets(), lambda: scene, tmp_path)


def test_every_backend_keeps_to_the_interface(backend):
    with one_thread():
        for question in (Question.of(THINGS), Question.of([BOX], [BALL], 1), Question.of([BALL])):
            graph = backend.infer(question)
            parents = {edge.child: edge.parent for edge in graph.edges}
            assert len(parents) == len(graph.edges) > 0
            assert set(graph.visible) <= set(question.visible)
            assert set(parents) <= set(graph.visible)
            assert set(parents.values()) <= {FLOOR, *graph.visible}
            assert {edge.relation for edge in graph.edges} <= set(RELATIONS)
            assert all(0 <= edge.confidence <= 1 and edge.said_by and edge.evidence for edge in graph.edges)
            problems = [(e.child, e.relation, e.parent) for e in graph.edges]
            silent = set(graph.visible) - set(parents)
            assert examine(problems, graph.visible, {FLOOR}, silent).problems == []
            assert backend.infer(question).edges == graph.edges


def test_every_backend_makes_a_whole_graph(backend):
    with one_thread():
        graph = infer_scene_graph(assets(), CONFIG, backend=backend)
    assert {e.child: e.parent for e in graph.edges} == dict.fromkeys(THINGS, FLOOR)


def test_a_model_is_shown_the_region_and_told_the_numbers(endpoint, scene):
    graph = load_relations(replace(CONFIG, backend="vlm"), assets(), lambda: scene).infer(Question.of(THINGS))
    text, picture = endpoint.requests[0]["messages"][0]["content"]
    assert picture["image_url"]["url"].startswith("data:image/jpeg")
    for line in (f"- {BOX}: crate", f"- {PANEL}: panel", f"- {BALL}: ball", f"- {FLOOR}: floor"):
        assert line in text["text"]
    assert max(graph.picture.shape) == 256
    assert {edge.said_by for edge in graph.edges} == {"tiny-vl"}
    assert all("geometry agrees" in edge.evidence for edge in graph.edges)


SENSE = [(BOX, "supported_by", FLOOR), (PANEL, "supported_by", FLOOR)]


@pytest.mark.parametrize(
    ("text", "reason", "doubted"),
    [
        ("The crate stands on the floor.", "no JSON object", set(THINGS)),
        (GOOD[:-30], "Invalid JSON", set(THINGS)),
        (GOOD.replace("supported_by", "under"), "supported_by", set(THINGS)),
        (answer(*SENSE, (BALL, "supported_by", 77)), "there is no 77", {BALL}),
        (answer(*SENSE, (BALL, "supported_by", BALL)), "nothing is its own parent", {BALL}),
        (answer(*SENSE, (BALL, "supported_by", FLOOR), (BALL, "attached_to", FLOOR)), "two parents", {BALL}),
        (answer(*SENSE), f"no edge for {BALL}", {BALL}),
        (answer(*SENSE, (BALL, "supported_by", PANEL)), "cannot touch", {BALL}),
        (answer((BOX, "supported_by", PANEL), (PANEL, "supported_by", BOX), (BALL, "supported_by", FLOOR)),
         "circle", {BOX, PANEL}),
        (answer(*SENSE, (BALL, "supported_by", FLOOR), (55, "supported_by", FLOOR)), "no object 55", set()),
        (answer(*SENSE, (BALL, "supported_by", FLOOR), (FLOOR, "attached_to", BOX)), "have no parent", set()),
        (answer(*SENSE, (BALL, "supported_by", FLOOR), unclear=[99]), "no object 99", set()),
    ],
)  # fmt: skip
def test_nonsense_is_asked_again_and_then_geometry_decides(endpoint, scene, text, reason, doubted):
    endpoint.responses = [chat(text)]
    notes = Notes()
    config = replace(CONFIG, backend="vlm")
    graph = infer_scene_graph(assets(), config, make_scene=lambda: scene, progress=notes)
    said_by = {edge.child: edge.said_by for edge in graph.edges}
    assert {i for i in THINGS if said_by[i] == "geometry"} == doubted
    assert {edge.parent for edge in graph.edges} == {FLOOR}
    assert len(endpoint.requests) == 3 * len([s for s in graph.steps if s.kind == "region"])
    assert reason in endpoint.requests[1]["messages"][-1]["content"]
    assert any("geometry decides" in line for line in notes.notes) == bool(doubted)


def test_a_model_that_comes_to_its_senses_is_believed(endpoint, scene):
    endpoint.responses = [chat("dunno"), chat(answer(*SENSE)), chat(GOOD)]
    backend = load_relations(replace(CONFIG, backend="vlm"), assets(), lambda: scene)
    graph = backend.infer(Question.of(THINGS))
    assert {edge.said_by for edge in graph.edges} == {"tiny-vl"}
    assert graph.notes == ()


def test_what_a_model_is_unsure_of_is_left_to_others(endpoint, scene):
    endpoint.responses = [chat(answer(*SENSE, unclear=[BALL]))]
    config = replace(CONFIG, backend="vlm", adjudications=2)
    graph = infer_scene_graph(assets(), config, make_scene=lambda: scene)
    assert {e.child: e.said_by for e in graph.edges} == {BOX: "tiny-vl", PANEL: "tiny-vl", BALL: "geometry"}
    assert [step.kind for step in graph.steps][-1] == "fallback"


def test_an_endpoint_that_is_away_is_asked_once(endpoint, scene):
    endpoint.responses = [(401, {}, "no")]
    notes = Notes()
    graph = infer_scene_graph(
        assets(), replace(CONFIG, backend="vlm"), make_scene=lambda: scene, progress=notes
    )
    assert {edge.said_by for edge in graph.edges} == {"geometry"}
    assert len(endpoint.requests) == 1
    assert any("HTTP 401" in line and "geometry decides from here on" in line for line in notes.notes)


def test_recorded_answers_are_replayed_without_an_endpoint(endpoint, scene, tmp_path, monkeypatch):
    config = replace(CONFIG, backend="vlm")
    asked = infer_scene_graph(assets(), config, make_scene=lambda: scene, records=tmp_path)
    number = len(endpoint.requests)
    assert len(list(tmp_path.glob("*.json"))) == number > 0
    monkeypatch.delenv("SIMRECON_VLM_URL")
    monkeypatch.setenv("SIMRECON_VLM_RECORDS", str(tmp_path))
    replayed = infer_scene_graph(assets(), config, make_scene=lambda: scene)
    assert replayed.edges == asked.edges
    assert len(endpoint.requests) == number


def test_a_model_in_process_sees_the_picture_and_answers_alike(qwen, tmp_path):
    model = QwenModel(ModelRequest(qwen, "a", "b", "cpu"), max_tokens=12)
    picture = np.random.default_rng(0).integers(0, 255, (90, 120, 3), dtype=np.uint8)

    def ask(image):
        content = [{"type": "text", "text": "What is on what?"}, {"type": "image", "image": image}]
        return model.request([{"role": "user", "content": content}], {}, "", "")

    with one_thread():
        assert ask(picture) == ask(picture) != ask(255 - picture)


def test_weights_that_are_not_there_are_said(scene):
    config = replace(CONFIG, backend="qwen2.5-vl", model="/nowhere/at/all")
    backend = load_relations(config, assets(), lambda: scene)
    with pytest.raises(EnvironmentMissing, match=r"scene_graph\.model=DIR"):
        backend.infer(Question.of(THINGS))


def test_geometry_looks_at_nothing():
    def never():
        raise AssertionError("no view is needed")

    infer_scene_graph(assets(), CONFIG, make_scene=never)


def test_another_model_does_not_reuse_a_result(monkeypatch):
    assert outside_inputs(CONFIG) == ()
    monkeypatch.setenv("SIMRECON_VLM_MODEL", "one")
    first = outside_inputs(replace(CONFIG, backend="vlm"))
    monkeypatch.setenv("SIMRECON_VLM_MODEL", "two")
    assert outside_inputs(replace(CONFIG, backend="vlm")) != first


def test_what_a_backend_lacks_is_said_before_the_run(monkeypatch):
    monkeypatch.delenv("SIMRECON_VLM_URL", raising=False)
    monkeypatch.delenv("SIMRECON_VLM_RECORDS", raising=False)
    check_backend(CONFIG)
    check_backend(replace(CONFIG, backend="qwen2.5-vl"))
    with pytest.raises(EnvironmentMissing, match=r"scene_graph\.backend needs .* set SIMRECON_VLM_URL"):
        check_backend(replace(CONFIG, backend="vlm"))


def test_nothing_stands_on_a_wall():
    found = examine([(5, "supported_by", 2), (6, "attached_to", 2)], {5, 6}, {1, 2}, walls={2})
    assert found.children == {5}
    assert "attached_to it" in found.problems[0]
