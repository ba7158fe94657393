"""Tables and page of a batch, from a real bundle in a registry."""

import csv
import io
import re
from dataclasses import replace

import pytest

from reconstruction.batch.figures import scene_figures
from reconstruction.batch.journal import VideoState
from reconstruction.batch.page import PER_PAGE, write_pages
from reconstruction.batch.results import Results, to_csv, write_parquet
from reconstruction.batch.rows import VideoRow

pytestmark = pytest.mark.unit


def rows_and_states(tmp_path, registry) -> tuple[list[VideoRow], dict[str, VideoState]]:
    rows = [VideoRow(name, tmp_path / f"{name} <b>.mp4") for name in ("room", "bad", "late")]
    revision = registry.get("room").revision
    states = {
        "room": VideoState(
            "room", result="published", kind="published", revision=revision, attempts=2, wall_s=9.0
        ),
        "bad": VideoState(
            "bad", result="failed", kind="video", cause="it is <i>black</i>", cure="Film again."
        ),
    }
    return rows, states


def test_every_single_figure_of_the_report_card_is_a_column(registry):
    bundle = registry.load("room")
    bundle.scene["report"]["physics"] = {
        "stable_rate": 0.5,
        "contacts": {"support_edges": 3, "supports_without_edge": [1, 2]},
        "objects": [{"id": 3, "name": "x", "moved_m": 0.1}],
        "spawn_penetration_mm": 0.0,
    }
    figures = scene_figures(bundle)
    assert figures["stable_rate"] == 0.5
    assert figures["contacts.support_edges"] == 3
    assert figures["contacts.n_supports_without_edge"] == 2
    assert figures["n_objects"] == len(bundle.scene["objects"])
    assert figures["bundle_bytes"] > 1000
    assert not any(isinstance(value, list | dict) for value in figures.values())


def test_tables_hold_all_videos_and_the_same_in_csv_and_parquet(tmp_path, registry):
    parquet = pytest.importorskip("pyarrow.parquet")
    rows, states = rows_and_states(tmp_path, registry)
    results = Results(tmp_path, registry)
    scenes, objects = results.tables(rows, states)
    assert results.write(scenes, objects) == []
    read = list(csv.DictReader(io.StringIO((tmp_path / "results.csv").read_text())))
    assert [line["state"] for line in read] == ["published", "failed", "waiting"]
    assert read[0]["n_objects"] == str(registry.get("room").n_objects)
    assert read[1]["cause"] == "it is <i>black</i>"
    table = parquet.read_table(tmp_path / "results.parquet").to_pylist()
    assert [line["scene"] for line in table] == ["room", "bad", "late"]
    assert table[0]["n_objects"] == registry.get("room").n_objects
    assert table[1]["n_objects"] is None
    assert list(table[0]) == list(read[0])


def test_columns_of_mixed_types_become_one_type(tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet")
    path = tmp_path / "t.parquet"
    write_parquet(path, [{"a": 1, "b": True, "c": "x"}, {"a": 0.5, "b": 3, "c": None}, {"a": None}])
    assert parquet.read_table(path).to_pylist() == [
        {"a": 1.0, "b": "True", "c": "x"},
        {"a": 0.5, "b": "3", "c": None},
        {"a": None, "b": None, "c": None},
    ]


def test_without_pyarrow_the_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "pyarrow", None)
    (note,) = write_parquet(tmp_path / "t.parquet", [{"a": 1}])
    assert "simrecon[lerobot]" in note
    assert not (tmp_path / "t.parquet").exists()


def test_texts_of_any_kind_stay_in_their_cells():
    rows = [{"scene": "a", "cause": 'x, "y"\nz'}, {"scene": "b", "cause": "=1+1;é"}]
    assert list(csv.DictReader(io.StringIO(to_csv(rows)))) == rows


def test_the_page_shows_scenes_and_failures_and_escapes_texts(tmp_path, registry):
    rows, states = rows_and_states(tmp_path, registry)
    scenes, _ = Results(tmp_path, registry).tables(rows, states)
    (tmp_path / "reports").mkdir()
    (tmp_path / "reports" / "room.html").write_text("x")
    (path,) = write_pages(tmp_path, "films", scenes)
    text = path.read_text()
    assert "it is &lt;i&gt;black&lt;/i&gt;" in text
    assert "Film again." in text
    assert "room &lt;b&gt;.mp4" in text
    assert "<i>" not in text
    for target in re.findall(r'(?:href|src)="([^"]+)"', text):
        assert target.startswith(
            ("data:", "results.csv", "objects.csv", "reports/room.html", "previews/room")
        ), target
        assert target.startswith("data:") or (tmp_path / target).exists() or target.endswith(".csv"), target


def test_many_scenes_are_on_several_pages(tmp_path, registry):
    rows, states = rows_and_states(tmp_path, registry)
    scenes, _ = Results(tmp_path, registry).tables(rows[:1], states)
    many = [{**scenes[0], "scene": f"s{n}"} for n in range(2 * PER_PAGE + 1)]
    paths = write_pages(tmp_path, "films", many)
    assert [path.name for path in paths] == ["index.html", "index_2.html", "index_3.html"]
    shown = [id_ for path in paths for id_ in re.findall(r'class="card" id="(\w+)"', path.read_text())]
    assert shown == [row["scene"] for row in many]
    for path in paths:
        assert 'href="index_3.html"' in path.read_text() or path.name == "index_3.html"


def test_a_scene_that_was_removed_since_keeps_its_row(tmp_path, registry):
    rows, states = rows_and_states(tmp_path, registry)
    states["room"] = replace(states["room"], revision="0" * 16)
    scenes, objects = Results(tmp_path, registry).tables(rows, states)
    assert scenes[0]["state"] == "published"
    assert objects == []
