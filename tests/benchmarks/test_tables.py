"""The tables say what the results say, and why something is missing. Results here are data for the layout."""

from dataclasses import replace

import pytest

from benchmarks.results import Result, load_results, save_result
from benchmarks.table import mean_of, render_page
from registry.errors import UsageError

CODE = {"commit": "abc123", "dirty": False, "sources": "now"}
METRICS = {
    "object_recall_25": 0.8,
    "object_precision_25": 0.6,
    "object_recall_50": 0.5,
    "object_precision_50": 0.4,
    "cd_cm": 3.21,
    "f_5cm": 65.4,
    "nc": 87.6,
    "object_cd_cm": 5.4,
    "object_f_1cm": 21.0,
    "graph_f1": 0.7,
    "psnr_db": 20.5,
    "ssim": 0.75,
    "coverage": 0.97,
    "stable_rate": 1.0,
    "stable_rate_10cm_0.1rad": 1.0,
    "stable_rate_5cm_drop_5deg": 1.0,
    "spawn_penetration_mm": 0.05,
    "floating_rate": 0.0,
    "ate_cm": 0.4,
    "scale_error": 0.031,
}


def made(capture: str, variant: str = "default", truth: str = "scene", **metrics: float | None) -> Result:
    """Return a result with METRICS, some of them changed."""
    return Result(
        capture=capture,
        truth=truth,
        variant=variant,
        arguments=[],
        meaning=f"meaning of {variant}",
        status="done",
        exit_code=0,
        error="",
        commit="abc123",
        dirty=False,
        date="2026-11-21T03:00:00Z",
        machine={"cpu": "A CPU", "cores": 2, "memory_gb": 23.4, "gpu": None},
        load_before=0.5,
        inputs="1",
        sources="now",
        report={
            "timings_s": {"frames": 10.0, "depth": 90.0, "publish": 2.0},
            "peak_memory_mb": 900.0,
            "registration": {"keyframes": 50, "registered": 45},
        },
        objects=7,
        evaluation={
            "metrics": METRICS | metrics,
            "left_out": {"ssim": "no frames | were kept out"},
            "news": 1,
        },
    )


def failed(capture: str, variant: str = "default", truth: str = "scene") -> Result:
    """Return the result of a run that failed."""
    error = "[1/9] frames: ...\nsimrecon reconstruct: frames: only 2 frames can be decoded"
    return replace(
        made(capture, variant, truth), status="reconstruct failed", exit_code=3, error=error, report={}, objects=None,
        evaluation={},
    )  # fmt: skip


def rows(page: str, section: str, first: str) -> list[list[str]]:
    """Return the cells of the table rows of a section whose first cell is `first`."""
    part = page[page.index(section) + len(section) :]
    level = section.split()[0]
    part = part[: part.index(f"\n{level} ")] if f"\n{level} " in part else part
    cells = [
        [cell.strip() for cell in line.split("|")[1:-1]] for line in part.splitlines() if line.startswith("|")
    ]
    return [row for row in cells if row[0] == first]


def test_means_are_over_captures_and_show_every_figure():
    page = render_page([made("a"), made("b", cd_cm=1.21, object_recall_25=0.4)], CODE)
    row = rows(page, "### Objects and geometry", "default")[0]
    assert row == [
        "default",
        "2 of 2",
        "0.60",
        "0.60",
        "0.50",
        "0.40",
        "2.21",
        "65.4",
        "87.6",
        "5.40",
        "21.0",
        "0.70",
    ]
    cost = rows(page, "### Rendering, cameras, cost", "default")[0]
    assert cost[2:4] == ["0.60", "0.60"]  # recall and precision stand beside every other figure
    assert cost[-2:] == ["102", "900"]
    assert rows(page, "### Physics", "default")[0][4:] == ["1.00", "1.00", "1.00", "0.05", "0.00"]


def test_all_rows_are_as_wide_as_their_head():
    results = [made("a"), failed("b"), made("a", "oracle-poses"), made("k", truth="cameras", cd_cm=None)]
    width = 0
    for line in render_page(results, CODE).splitlines():
        if not line.startswith("|"):
            width = 0
            continue
        cells = line.replace("\\|", "").count("|")
        assert cells == (width or cells), line
        width = cells


def test_a_failed_run_is_a_row_counts_as_recall_zero_and_does_not_improve_the_rest():
    results = [made("a"), failed("b")]
    assert mean_of(results, "object_recall_25") == (0.4, 2)
    assert mean_of(results, "cd_cm") == (3.21, 1)
    page = render_page(results, CODE)
    mean = rows(page, "### Objects and geometry", "default")[0]
    assert mean[:3] == ["default", "1 of 2", "0.40"]
    row = rows(page, "### b", "default<sup>1</sup>")[0]
    assert row[1:3] == ["r2", "failed"]
    assert (
        "reconstruct failed, exit code 3: simrecon reconstruct: frames: only 2 frames can be decoded" in page
    )


def test_a_missing_figure_is_a_dash_with_its_reason():
    page = render_page([made("a", ssim=None), made("b", graph_f1=None)], CODE)
    section = page[page.index("### a") : page.index("### b")]
    assert "–<sup>1</sup>" in section
    assert "<sup>1</sup> no frames \\| were kept out" in section
    assert "the evaluation has no graph_f1" in page[page.index("### b") :]
    assert "0.750<sup>1</sup>" in page  # the mean is over the capture that has it, and says so
    assert "without a, which have no such figure" in page


def test_oracles_are_differences_to_the_default_on_the_same_captures():
    results = [
        made("a", cd_cm=4.0),
        made("b", cd_cm=2.0),
        made("a", "oracle-poses", cd_cm=3.0, object_recall_25=0.9),
        made("c", "oracle-poses", cd_cm=0.0),  # no default run on c: it does not count
    ]
    page = render_page(results, CODE)
    section = "## What each stage costs"
    row = rows(page, section, "oracle-poses")[0]
    assert row[1:6] == ["1", "+0.10", "+0.00", "-1.00", "+0.0"]
    absolute = rows(page, section, "default (absolute)")[0]
    assert absolute[4] == "3.00"


def test_captures_without_entities_have_a_table_of_their_own():
    results = [made("a"), made("dorm", truth="none", cd_cm=None, ate_cm=None), failed("fox", truth="none")]
    page = render_page(results, CODE)
    section = "## Real captures without full truth"
    row = rows(page, section, "dorm")[0]
    assert row[1:6] == ["default", "r2", "0.90", "7", "20.50"]
    assert rows(page, section, "fox")[0][3] == "failed"
    assert "1 captures: a." in page[page.index("## Variants") :]
    assert "### dorm" not in page


def test_captures_with_labels_have_a_table_of_outlines():
    figures = {"outline_recall_25": 0.41, "outline_precision_25": 0.85, "outline_recall_50": 0.3}
    figures |= {"outline_precision_50": 0.6, "outline_things": 46, "outline_objects": 20, "outline_frames": 6}
    kitchen = made("kitchen", truth="cameras", **figures, outline_edges=None)
    lost = failed("kitchen", "fast", truth="cameras")
    page = render_page([made("a"), made("fox", truth="none"), kitchen, lost], CODE)
    section = "## Outlines drawn by hand"
    row = rows(page, section, "kitchen")[0]
    assert row[3:7] == ["0.41", "0.85", "0.30", "0.60"]
    assert row[7].startswith("–")
    assert row[8:] == ["46", "20", "6"]
    assert rows(page, section, "kitchen")[1][3] == "failed"
    assert not rows(page, section, "fox")
    assert "Not measured yet." in render_page([made("a")], CODE).split(section)[1]


def test_every_row_leads_to_machine_commit_and_date_and_old_code_is_marked():
    old = replace(made("b"), commit="old99", sources="before", dirty=True)
    page = render_page([made("a"), old], CODE)
    assert "**machine 1**: A CPU, 2 cores, 23 GB memory, no GPU" in page
    assert rows(page, "## Runs", "r1")[0] == ["r1", "a", "default", "1", "abc123", "2026-11-21 03:00", "0.5"]
    assert rows(page, "## Runs", "r2")[0][4] == "old99 + changes †"
    assert "1 of 2 runs are of an older state of the code" in page


def test_the_papers_rows_are_marked_as_other_data_and_hardware():
    page = render_page([made("a")], CODE)
    row = rows(page, "### The paper's figures", "SimRecon (the paper)")[0]
    assert row == ["SimRecon (the paper)", "4.34", "62.65", "87.37", "24.43", "0.924", "0.153", "1260"]
    part = page[page.index("### The paper's figures") : page.index("## What each stage")]
    assert "other data" in part
    assert "other hardware" in part
    assert "cd cm ↓ *" in part
    assert "time s ↓ *" not in part


def test_variants_that_skip_captures_say_so():
    page = render_page([made("a"), made("b"), made("a", "fast")], CODE)
    assert rows(page, "### Objects and geometry", "fast<sup>1</sup>") == []
    assert rows(page, "### Objects and geometry", "fast")[0][1] == "1 of 1<sup>1</sup>"
    assert "not run on b: compare with care" in page


def test_a_page_without_results_is_a_page():
    assert "Not measured yet." in render_page([], CODE)


def test_results_survive_the_disk_and_unknown_keys(tmp_path):
    result = made("a")
    path = save_result(result, tmp_path)
    path.write_text(path.read_text().replace('"capture"', '"future": 1,\n "capture"', 1))
    assert load_results(tmp_path) == [result]
    path.write_text("[1]")
    with pytest.raises(UsageError, match=r"default\.json"):
        load_results(tmp_path)


def test_stages_that_no_run_had_have_no_column_and_others_do():
    result = made("a")
    stages = {"depth": {"median_rel": 0.0123}, "instances": {"surface": {"mean_iou": 0.5}, "per_view": None}}
    result = replace(result, evaluation=result.evaluation | {"stages": stages})
    page = render_page([result], CODE)
    heads = rows(page, "### Stages", "variant")[0]
    assert heads[2:] == ["recall@.25 ↑", "prec@.25 ↑", "depth error % ↓", "instances IoU ↑"]
    assert rows(page, "### Stages", "default")[0][-2:] == ["1.23", "0.50"]


def test_time_by_stage_is_the_mean_over_captures_in_the_order_of_the_run():
    slow = made("b")
    slow = replace(slow, report=slow.report | {"timings_s": {"depth": 30.0, "frames": 20.0, "publish": 4.0}})
    page = render_page([made("a"), slow, failed("c")], CODE)
    section = "## Time by stage"
    assert rows(page, section, "variant")[0] == ["variant", "captures", "frames", "depth", "publish", "total"]
    assert rows(page, section, "default")[0] == ["default", "2", "15.0", "60.0", "3.0", "78"]
