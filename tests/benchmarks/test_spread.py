"""Several runs of one variant become one row with mean and spread. Results here are data for the layout."""

import json
from dataclasses import replace

import pytest
from test_tables import CODE, failed, made, rows

from benchmarks.results import save_result
from benchmarks.run import main
from benchmarks.spread import PooledResult, pool, save_spreads, spread_of, spread_tree
from benchmarks.table import render_page
from benchmarks.variants import VARIANTS, perturbed_variants, run_of, scene_id
from registry.schema import check_scene_id


def test_mean_and_spread():
    found = spread_of([1.0, None, 2.0, float("nan"), 6.0])
    assert (found.mean, found.min, found.max, found.runs) == (3.0, 1.0, 6.0, 3)
    assert found.sd == pytest.approx(7**0.5)
    assert spread_of([4.0]).sd == 0.0
    assert spread_of([None]) is None


def test_nested_figures_keep_their_names_and_lose_what_is_no_number():
    tree = spread_tree([{"a": {"b": 1.0}, "c": "x", "d": None}, {"a": {"b": 3.0}, "c": "y", "d": None}])
    assert tree["a"]["b"]["mean"] == 2.0
    assert tree["d"] is None
    assert "c" not in tree


def test_runs_have_names_scenes_and_seeds_of_their_own():
    default = next(variant for variant in VARIANTS if variant.name == "default")
    runs = perturbed_variants(default, 3)
    assert [run_of(run.name) for run in runs] == [("default", 0), ("default", 1), ("default", 2)]
    assert runs[0] is default
    assert runs[2].arguments == ("--set", "depth.perturb=2")
    assert len({scene_id(run) for run in runs}) == 3
    for run in runs:
        check_scene_id(scene_id(run))


def test_the_true_depth_is_not_run_again():
    by_name = {variant.name: variant for variant in VARIANTS}
    assert len(perturbed_variants(by_name["oracle-depth"], 5)) == 1
    assert len(perturbed_variants(by_name["oracle-all"], 5)) == 1
    assert len(perturbed_variants(by_name["oracle-poses"], 5)) == 5


def test_a_page_shows_mean_and_deviation_of_a_capture_and_of_the_mean_over_captures():
    results = [
        made("a", cd_cm=2.0), made("a", "default+p1", cd_cm=4.0),
        made("b", cd_cm=5.0), made("b", "default+p1", cd_cm=3.0), made("a", "fast", cd_cm=9.0),
    ]  # fmt: skip
    page = render_page(results, CODE)
    assert rows(page, "### a", "default")[0][6] == "3.00 ± 1.41"
    assert (
        rows(page, "### Objects and geometry", "default")[0][6] == "3.50 ± 0.00"
    )  # one rose as the other fell
    assert rows(page, "### Objects and geometry", "fast")[0][6] == "9.00"
    assert "mean ± standard deviation of 2 runs" in page
    assert "default, 2 runs" in page
    assert "+p1" not in page


def test_a_run_that_failed_counts_as_recall_zero_and_is_named():
    results = [made("a", object_recall_25=0.8), failed("a", "default+p1")]
    only = pool(results)[0]
    assert isinstance(only, PooledResult)
    assert only.metrics["object_recall_25"] == 0.4
    assert only.metrics["cd_cm"] == 3.21
    page = render_page(results, CODE)
    assert "1 of 2 runs failed: simrecon reconstruct: frames" in page


def test_runs_of_other_code_or_input_are_left_out():
    new = made("a")
    old = [replace(made("a", "default+p1"), sources="before"), replace(made("a", "default+p2"), inputs="2")]
    assert pool([new, *old]) == [new]


def test_least_and_greatest_are_kept_in_a_file(tmp_path):
    results = [made("a", cd_cm=2.0), made("a", "default+p1", cd_cm=4.0), made("b")]
    (path,) = save_spreads(results, tmp_path)
    assert path == tmp_path / "a" / "spread" / "default.json"
    data = json.loads(path.read_text())
    assert data["runs"] == ["default", "default+p1"]
    cd = data["figures"]["cd_cm"]
    assert (cd["mean"], cd["min"], cd["max"], cd["runs"]) == (3.0, 2.0, 4.0, 2)


@pytest.mark.stage  # runs a command
def test_what_would_be_run_is_said(tmp_path, capsys):
    (tmp_path / "captures" / "room").mkdir(parents=True)
    (tmp_path / "captures" / "room" / "video.mp4").write_bytes(b"a film")
    save_result(made("room"), tmp_path / "out")
    line = ["--captures", str(tmp_path / "captures"), "--out", str(tmp_path / "out"), "--dry-run"]
    assert main([*line, "--perturb", "3"]) == 0
    said = capsys.readouterr().out
    assert all(f"room / default{mark}: to do" in said for mark in ("", "+p1", "+p2"))
    assert "+p3" not in said
    assert main([*line, "--perturb", "0"]) == 2
    assert "--perturb" in capsys.readouterr().err
