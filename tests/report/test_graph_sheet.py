"""`simrecon show SCENE --graph`: the source of each edge, and an image of every step."""

import json

import cv2
import numpy as np
import pytest

from reconstruction.cli import main
from reconstruction.measure.report.graph_sheet import draw_step, draw_tree, write_graph_steps

pytestmark = pytest.mark.stage

NAMES = {1: "floor", 2: "wall", 3: "table", 4: "book", 5: "mug", 6: "picture"}


def edge(child, parent, relation="supported_by") -> dict:
    return {"child": child, "relation": relation, "parent": parent}


def step(said, decisions=(), merged=None, kind="region") -> dict:
    ids = sorted({e["child"] for e in said})
    full = [e | {"verdict": v, "why": w} for e, v, w in decisions]
    return {
        "kind": kind, "about": ids, "visible": ids, "said": said, "decisions": full, "notes": [],
        "merged": said if merged is None else merged,
    }  # fmt: skip


RIGHT = [edge(3, 1), edge(4, 3), edge(5, 4), edge(6, 2, "attached_to")]
WRONG = [edge(3, 1), edge(5, 3)]
STEPS = [
    step(RIGHT, [(e, "new", "") for e in RIGHT]),
    step(WRONG, [(WRONG[0], "known", ""), (WRONG[1], "conflict", "no path leads there")], RIGHT),
    step(RIGHT[:3], [(RIGHT[2], "kept", "")], RIGHT, "adjudication"),
]


def test_the_steps_of_a_scene_are_drawn_from_its_work_folder(reconstructed, tmp_path, capsys):
    registry = ["--registry", str(reconstructed.registry)]
    assert main(["show", "small_room", "--graph", *registry, "--out", str(tmp_path), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    scene = json.loads(next(reconstructed.registry.glob("scenes/small_room/*/scene.json")).read_text())
    assert {e["said_by"] for e in said["edges"]} <= {"geometry", "assembly"}
    assert len(said["files"]) == len(scene["graph"]["steps"]) > 0
    picture = cv2.imread(said["files"][0])
    view = picture[100:400, 30:500].astype(float)
    assert view.std() > 15  # something was looked at
    nowhere = ["--work-dir", str(tmp_path / "nowhere"), "--out", str(tmp_path / "bare")]
    assert main(["show", "small_room", "--graph", *registry, *nowhere]) == 0
    out = capsys.readouterr()
    assert "only graphs are drawn" in out.err
    assert "geometry: " in out.out
    bare = cv2.imread(str(tmp_path / "bare" / "step_01.png"))
    assert bare.shape[0] < picture.shape[0]


def test_what_a_model_was_shown_stays_in_the_picture(tmp_path):
    shown = np.zeros((300, 400, 3), np.uint8)
    shown[..., 0] = 250
    files = write_graph_steps(STEPS, NAMES, [shown, None, shown], tmp_path)
    red = [(cv2.imread(str(f)) == (0, 0, 250)).all(axis=2).sum() for f in files]
    assert red[0] == red[2] == 300 * 400
    assert red[1] == 0


def test_a_conflict_is_red_and_said_in_words():
    picture = draw_step("two", STEPS[1], NAMES, None, set())
    plain = draw_step("two", STEPS[0], NAMES, None, set())
    assert ((picture == (206, 40, 52)).all(axis=2)).sum() > 20
    assert not ((plain == (206, 40, 52)).all(axis=2)).any()


def test_every_thing_has_a_row_and_attachments_are_dashed():
    triples = [(e["child"], e["relation"], e["parent"]) for e in RIGHT]
    solid = [(c, "supported_by", p) for c, _, p in triples]
    colors = {t: (1, 2, 3) for t in [*triples, *solid]}
    tree = draw_tree(triples, NAMES, colors)
    assert tree.shape[0] == 24 * 6  # floor, table, book, mug, wall, picture
    less = (draw_tree(solid, NAMES, colors) == (1, 2, 3)).all(axis=2).sum()
    assert 0 < (tree == (1, 2, 3)).all(axis=2).sum() < less


def test_what_is_wrong_is_said(reconstructed, capsys):
    registry = ["--registry", str(reconstructed.registry)]
    assert main(["show", "small_room", *registry, "--graph", "--views"]) == 2
    assert "give only one of them" in capsys.readouterr().err
    assert main(["show", "small_room", *registry, "--graph", "--set", "avo.views=1"]) == 2
    assert "--set needs --views" in capsys.readouterr().err


@pytest.mark.parametrize("edges", [[], [(4, "supported_by", 3)]])
def test_a_graph_without_roots_or_edges_can_be_drawn(edges):
    assert draw_tree(edges, NAMES, {}).shape[0] == 24 * max(len(edges) * 2, 1)
