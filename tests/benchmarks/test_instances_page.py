"""The tables of the instances benchmark say what the records say. Records here are data for the layout."""

import json
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from test_tables import failed

from benchmarks.captures import find_captures
from benchmarks.instances import main, scene_results, stage_run
from benchmarks.instances_page import Measured, pooled, render
from benchmarks.results import save_result
from benchmarks.variants import choose_variants

CODE = {"commit": "abc", "dirty": False, "sources": "now"}


def record(name: str, side_cm: float, support: str, gap_cm: float | None, iou: float) -> dict:
    """Return a record of a true object whose best box has this IoU."""
    return {
        "true_id": 1,
        "name": name,
        "visible_pixels": 5000,
        "longest_side_cm": side_cm,
        "support": support,
        "gap_cm": gap_cm,
        "box_iou": iou,
        "found_25": iou >= 0.25,
        "found_50": iou >= 0.5,
    }


MUG = record("mug", 12.0, "thing", 1.5, 0.1)
TABLE = record("table", 120.0, "floor", None, 0.9)
PLATE = record("plate", 22.0, "furniture", 3.0, 0.4)


def measured(capture: str, records: list[dict], found: int, **changed) -> Measured:
    """Return figures of one capture."""
    out = Measured(
        capture=capture,
        group="rooms",
        variant="default",
        meaning="the preset",
        figures={"found": found},
        records=records,
        surface_points=100_000,
        wall_s=12.0,
        cpu_s=9.0,
        commit="abc",
        dirty=False,
        sources="now",
        date="2026-11-21T15:00:00Z",
        machine={"cpu": "A CPU", "cores": 2, "memory_gb": 23.4, "gpu": None},
    )
    return replace(out, **changed)


RESULTS = [measured("one", [MUG, TABLE], 3), measured("two", [PLATE], 2)]


def rows(page: str, first: str) -> list[list[str]]:
    """Return the cells of the table rows whose first cell is `first`."""
    lines = [
        [c.strip() for c in line.strip("|").split("|")] for line in page.splitlines() if line.startswith("|")
    ]
    return [cells for cells in lines if cells[0] == first]


def test_recall_and_precision_are_pooled_over_objects():
    recall, precision = pooled(RESULTS, 25)
    assert (recall.found, recall.count, precision.found, precision.count) == (2, 3, 2, 5)
    recall, precision = pooled(RESULTS, 50)
    assert (recall.found, recall.count, precision.found, precision.count) == (1, 3, 1, 5)


def test_the_page_has_the_pool_the_captures_and_the_four_breakdowns():
    page = render(RESULTS, [], None, CODE)
    # 2 of 3: Wilson's interval is [0.208, 0.939]; 2 of 5: [0.118, 0.769].
    (pool,) = rows(page, "rooms (2)")
    assert pool[1:5] == ["default", "3", "0.67 [0.21, 0.94]", "0.40 [0.12, 0.77]"]
    assert rows(page, "two")[0] == ["two", "default", "1", "1.00", "0.50", "0.00", "0.00"]
    assert rows(page, "10–20 cm") == [["10–20 cm", "1", "0.00 [0.00, 0.79]", "0.00 [0.00, 0.79]"]]
    assert rows(page, "on furniture")[0][2:] == ["1.00 [0.21, 1.00]", "0.00 [0.00, 0.79]"]
    assert rows(page, "< 2 cm")[0][1] == "1"
    assert [cells[1] for cells in rows(page, "all")] == ["3", "3", "3", "3"]
    assert "Whole scenes" not in page


def test_misses_are_named_with_what_makes_them_hard():
    page = render(RESULTS, [], None, CODE)
    (missed,) = [cells for cells in rows(page, "one") if "mug" in cells]
    assert missed == ["one", "default", "mug", "thing", "12", "1.5", "5,000", "0.10"]
    assert not [cells for cells in rows(page, "two") if "plate" in cells]


def test_variants_stand_side_by_side_and_a_missing_bin_is_a_dash():
    other = measured("one", [TABLE], 1, variant="true-masks", meaning="the truth")
    page = render([*RESULTS, other], [], None, CODE)
    assert rows(page, "≥ 50 cm")[0][2:] == ["1.00 [0.21, 1.00]"] * 4
    assert rows(page, "10–20 cm")[0][4:] == ["–", "–"]


def test_scenes_and_growth_are_shown_where_they_were_measured():
    scene = measured("one", [MUG, TABLE], 2, surface_points=None, cpu_s=None, wall_s=47.0, sources="before")
    growth = {
        "capture": "one",
        "variant": "default",
        "commit": "abc",
        "rows": [
            {"voxel_mm": v, "points": n, "cpu_s": 2.0 + n / 10_000, "wall_s": 1.0}
            for v, n in ((16, 40_000), (12, 70_000), (8, 160_000))
        ],
    }
    page = render(RESULTS, [scene], growth, CODE)
    assert page.index("## Whole scenes") < page.index("## The instances stage alone")
    assert "at most 47 s" in page
    assert "0.100 s of CPU a thousand surface points + 2.0 s, R² 1.000" in page
    assert "abc † (2026-11-21, 1 results)" in page


def test_a_run_is_what_the_command_line_would_do(tmp_path):
    video = tmp_path / "video.mp4"
    video.write_bytes(b"not looked at yet")
    run = stage_run(video, tmp_path / "work", ["--preset", "fast", "--set", "instances.min_picture_m=0.05"])
    assert run.config.instances.min_picture_m == 0.05
    assert run.config.instances.snap_radius_px == 0  # of the preset
    assert run.oracle is None


def test_captures_without_entities_are_refused(tmp_path, capsys):
    (tmp_path / "room" / "ground_truth").mkdir(parents=True)
    (tmp_path / "room" / "video.mp4").write_bytes(b"x")
    (tmp_path / "room" / "ground_truth" / "cameras.json").write_text(json.dumps({}))
    assert main(["--captures", str(tmp_path), "--out", str(tmp_path / "out")]) == 2
    assert "scene.json" in capsys.readouterr().err


@pytest.mark.stage  # runs a command
def test_what_would_be_done_is_said_and_not_done(tmp_path, capsys):
    (tmp_path / "room" / "ground_truth").mkdir(parents=True)
    (tmp_path / "room" / "video.mp4").write_bytes(b"x")
    (tmp_path / "room" / "ground_truth" / "scene.json").write_text("{}")
    assert [c.truth for c in find_captures([tmp_path])] == ["scene"]
    page, out = tmp_path / "page.md", tmp_path / "out"
    words = [
        "--captures",
        str(tmp_path),
        "--variants",
        "default",
        "true-masks",
        "--out",
        str(out),
        "--page",
        str(page),
    ]
    assert main([*words, "--dry-run"]) == 0
    said = capsys.readouterr().out
    assert "room / default: to do" in said
    assert "room / true-masks: to do" in said
    assert not page.exists()
    assert not out.exists()


def test_a_scene_that_failed_missed_everything(tmp_path):
    truth = tmp_path / "rooms" / "one" / "ground_truth"
    truth.mkdir(parents=True)
    (truth.parent / "video.mp4").write_bytes(b"x")
    trimesh.creation.box((0.3, 0.2, 0.1)).export(truth / "box.ply")
    box = {"id": 1, "name": "box", "label": "box", "base": False, "visible_pixels": 9000, "mesh": "box.ply"}
    intrinsics = {"fx": 500, "fy": 500, "cx": 320, "cy": 240}
    frames = [{"index": 0, "world_from_camera": np.eye(4).tolist()}]
    scene = {"width": 640, "height": 480, "intrinsics": intrinsics, "frames": frames, "entities": [box]}
    (truth / "scene.json").write_text(json.dumps(scene))
    (capture,), out = find_captures([tmp_path / "rooms"]), tmp_path / "out"
    save_result(failed("one"), out)
    (missed,) = scene_results([capture], choose_variants(["default"], []), out)
    assert [(r["name"], r["found_25"]) for r in missed.records] == [("box", False)]
    assert missed.records[0]["longest_side_cm"] == pytest.approx(30)
    recall, precision = pooled([missed], 25)
    assert (recall.value, recall.count, precision.count) == (0, 1, 0)
